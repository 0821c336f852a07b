"""Tools of `fmi_spomf`: images turned into shifts, and shifts found."""
