"""Scan against scan, section by section (`reproduce_fsm.py`)."""
