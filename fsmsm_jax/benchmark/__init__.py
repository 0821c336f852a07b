"""How fast is it here, and is it slower than it was?

`metric` is a row, `clock` a time that means something, `stages` what is timed,
`scaling` how it grows, `record` where measurements are kept and compared, `page` how
they are told. `fsmsm bench` puts them together.
"""

from fsmsm_jax.benchmark.metric import Metric as Metric, regressions as regressions
from fsmsm_jax.benchmark.clock import (
    Clocked as Clocked,
    clock as clock,
    ratio_to_reference as ratio_to_reference,
    reference_workload as reference_workload,
    seconds as seconds,
)
from fsmsm_jax.benchmark.stages import (
    STAGES as STAGES,
    Amounts as Amounts,
    Scene as Scene,
    Stage as Stage,
    measure as measure,
    random_poses as random_poses,
    rays_from as rays_from,
    simulated_scans as simulated_scans,
)
from fsmsm_jax.benchmark.scaling import CURVES as CURVES, Curve as Curve
from fsmsm_jax.benchmark.record import (
    Record as Record,
    baseline_path as baseline_path,
    baselines as baselines,
    circumstances as circumstances,
    read_record as read_record,
    write_record as write_record,
)
from fsmsm_jax.benchmark.page import (
    markdown as markdown,
    with_page as with_page,
)
