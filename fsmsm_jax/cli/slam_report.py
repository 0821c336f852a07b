"""What came of a SLAM run: in numbers for programs, in words for people.

The truth, where a log knows some, is compared with twice: as it is, and aligned by the
rigid motion that brings the whole way closest to the reference (`evaluation.slam`).
The map is moved as the way is.
"""

import numpy as np
from jaxtyping import Float, Int

from fsmsm_jax.cli.console import pose_in_words
from fsmsm_jax.cli.legs import Driven
from fsmsm_jax.evaluation.drift import way
from fsmsm_jax.evaluation.slam import map_error, moved, way_error
from fsmsm_jax.io.landmarks import LandmarkLog
from fsmsm_jax.slam.filter import SlamConfig

__all__ = ["contents", "metrics_of", "remarks_on", "report", "told_ids"]


def told_ids(log: LandmarkLog) -> Int[np.ndarray, "ids"]:
    """Of all detections that have one."""
    told = np.asarray(log.drive.ids)[np.asarray(log.drive.valid)]
    return told[told >= 0]


def metrics_of(config: SlamConfig, log: LandmarkLog, found: Driven) -> dict:
    """The run in numbers, for JSON."""
    info = found.info
    poses = np.asarray(info.pose, float)
    known = np.asarray(found.landmarks.known)
    places = np.stack([*found.landmarks.place], axis=-1)[known].astype(float)
    detections = int(np.sum(log.drive.valid))
    sigma = np.sqrt(np.diagonal(np.asarray(info.covariance[-1], float)))
    to_reference, gauge = _to_reference(log, poses)
    return {
        "method": config.method,
        "particles": config.particles,
        "steps": len(poses),
        "duration_s": float(log.times[-1] - log.times[0]),
        "distance_m": float(way(poses)[-1]),
        "landmarks": int(known.sum()),
        "slots": len(known),
        "detections": detections,
        "matched": int(info.matched.sum()),
        "unplaced": int(info.unplaced.sum()),
        "log_evidence": float(info.log_evidence.sum(dtype=float)),
        "unexplained_steps": int(np.sum(~info.usable)),
        "effective": {
            "median": float(np.median(info.effective)),
            "least": float(np.min(info.effective)),
        },
        "compiling_s": found.compiling,
        "seconds": found.seconds,
        "steps_per_second": len(poses) / found.seconds,
        "last": {"pose": poses[-1].tolist(), "sigma": sigma.tolist()},
        "reference": to_reference,
        "survey": _to_survey(log, places, gauge),
    }


def _to_reference(
    log: LandmarkLog, poses: Float[np.ndarray, "steps 3"]
) -> tuple[dict | None, Float[np.ndarray, "3"] | None]:
    """Errors of the way and the motion that aligns it; None without a reference."""
    fixes = log.reference[np.isfinite(log.reference).all(axis=1)]
    during = (fixes[:, 0] >= log.times[0]) & (fixes[:, 0] <= log.times[-1])
    if not during.any():
        return None, None
    error = way_error(log.times, poses, fixes)
    return {
        "fixes": int(during.sum()),
        "median_m": float(np.median(error.distance)),
        "rms_m": float(error.rms),
        "aligned_median_m": float(np.median(error.aligned)),
        "aligned_rms_m": float(error.aligned_rms),
    }, error.gauge


def _to_survey(
    log: LandmarkLog,
    places: Float[np.ndarray, "landmarks 2"],
    gauge: Float[np.ndarray, "3"] | None,
) -> dict | None:
    """Errors of the map; None without a survey."""
    if log.landmarks is None:
        return None
    error = map_error(places, log.landmarks)
    aligned = None if gauge is None else map_error(moved(gauge, places), log.landmarks)
    rms = lambda found: None if found is None or not len(found.distance) else found.rms
    return {
        "surveyed": len(log.landmarks),
        "missing": error.missing,
        "extra": error.extra,
        "rms_m": rms(error),
        "aligned_rms_m": rms(aligned),
    }


def remarks_on(log: LandmarkLog, metrics: dict, ids: bool) -> list[str]:
    """What is odd about the run."""
    said = []
    if unplaced := metrics["unplaced"]:
        said.append(
            f"{unplaced} detections of new landmarks found all {metrics['slots']} "
            "slots taken: raise --landmarks"
        )
    if steps := metrics["unexplained_steps"]:
        said.append(f"in {steps} steps no particle explains what was detected")
    if ids and (without := metrics["detections"] - told_ids(log).size):
        said.append(f"{without} detections have no id and were left alone")
    told, mapped = np.unique(told_ids(log)).size, metrics["landmarks"]
    if not ids and told and mapped > 2 * told:
        said.append(
            f"the map has {mapped} landmarks where the log tells {told} apart: --ids "
            "believes it"
        )
    if len(log.reference) and metrics["reference"] is None:
        said.append("no place of the reference is of the time of the drive")
    return said


def contents(log: LandmarkLog) -> str:
    """What is in a log, in words."""
    ids = np.unique(told_ids(log)).size
    return (
        f"{len(log.times)} looks in {log.times[-1] - log.times[0]:.0f} s, "
        f"{np.sum(log.drive.valid)} detections, "
        + (f"of {ids} landmarks by its ids" if ids else "without ids")
    )


def report(metrics: dict, remarks: list[str]) -> str:
    """A run's metrics for people."""
    m, effective, last = metrics, metrics["effective"], metrics["last"]
    share = 100 * m["matched"] / max(m["detections"], 1)
    place = pose_in_words(last["pose"], np.diag(np.square(last["sigma"])))
    lines = [
        f"slam      {m['method']}: {m['landmarks']} landmarks on the map; "
        f"{share:.1f} % of the detections matched",
        f"particles {m['particles']}, of which {effective['median']:.1f} effective "
        f"(median), {effective['least']:.1f} at least",
        f"time      {m['seconds']:.1f} s, {m['steps_per_second']:.0f} steps/s with "
        f"{m['slots']} slots, after {m['compiling_s']:.1f} s for compiling",
        f"distance  {m['distance_m']:.1f} m",
    ]
    if way_ := m["reference"]:
        lines.append(
            f"way       {way_['median_m']:.2f} m from the reference (median), RMS "
            f"{way_['rms_m']:.2f} m; aligned {way_['aligned_median_m']:.2f} m and "
            f"{way_['aligned_rms_m']:.2f} m; {way_['fixes']} fixes"
        )
    if survey := m["survey"]:
        rms = lambda n: "unknown" if n is None else f"{n:.2f} m"
        lines.append(
            f"survey    {survey['surveyed'] - survey['missing']} of "
            f"{survey['surveyed']} landmarks found, {survey['extra']} more that are "
            f"none; RMS {rms(survey['rms_m'])}, aligned {rms(survey['aligned_rms_m'])}"
        )
    lines.append(f"pose      {place} at the last look")
    return "\n".join([*lines, *(f"remark    {remark}" for remark in remarks)])
