import json
import re
import subprocess
import sys
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import cli
from fsmsm_jax.io.programs import platform_here
from fsmsm_jax.io.stored import load_tracker
from fsmsm_jax.localisation import AtlasConfig, build_atlas
from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world.buildings import office
from fsmsm_jax.world.ros_map import save_map

TRUTH = jnp.array([7.5, 4.0, 0.8])
NEAR = (7.62, 3.9, 62.0)  # m, m, degrees


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder of a small map, its atlas, and a log: a scan of nothing, one of the map."""
    folder = tmp_path_factory.mktemp("recorded")
    world = office(seed=1, width=15.0, height=10.0)
    lidar = Lidar.create(180, noise=0.01)
    scan = lidar.measure(jax.random.key(0), raycast(world, TRUTH, lidar.bearings))
    save_map(world, folder / "map.yaml")
    build_atlas(world, AtlasConfig(spacing=0.5)).save(folder / "map.atlas.npz")
    np.savez(
        folder / "log.npz",
        ranges=[np.full(180, 31.0), scan.ranges],
        bearings=lidar.bearings,
        range_max=30.0,
    )
    return folder


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FSMSM_NO_CACHE", "1")


def localise(folder, *options, atlas="map.atlas.npz"):
    """Run the command on the recorded files; the exit status."""
    files = [str(folder / "map.yaml"), str(folder / "log.npz")]
    return cli.main(["localise", *files, "--atlas", str(folder / atlas), *options])


def test_localise_finds_the_scan_in_words_and_in_a_picture(recorded, capsys, tmp_path):
    assert localise(recorded, "--index", "-1") == 0
    out = capsys.readouterr().out
    assert "180 rays over 358°" in out
    pose = re.search(r"x (\S+) m ± \S+, y (\S+) m ± \S+, heading (\S+)°", out)
    found = np.array([float(group) for group in pose.groups()])
    np.testing.assert_allclose(found[:2], TRUTH[:2], atol=0.03)
    np.testing.assert_allclose(np.deg2rad(found[2]), TRUTH[2], atol=0.01)
    for word in (
        "verdict   ",
        "confident",
        "CAER",
        "1σ",
        "picture   localise.png",
        " ms",
    ):
        assert word in out
    assert (tmp_path / "localise.png").read_bytes().startswith(b"\x89PNG")


def test_json_is_all_of_stdout(recorded, capsys, tmp_path):
    assert localise(recorded, "--index", "1", "--json", "--picture", "none") == 0
    answer = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(answer["pose"], TRUTH, atol=0.03)
    assert np.shape(answer["covariance"]) == (3, 3)
    assert answer["candidates"][0]["pose"] == answer["pose"]
    assert isinstance(answer["confident"], bool)
    assert answer["seconds"].keys() == {"atlas", "first_query", "query"}
    assert not list(tmp_path.iterdir())


def test_atlas_is_built_kept_and_used_again(recorded, capsys, tmp_path):
    options = ("--index", "1", "--spacing", "0.5", "--json", "--picture", "none")
    answers = []
    for _ in range(2):
        assert localise(recorded, *options, atlas=tmp_path / "new.npz") == 0
        captured = capsys.readouterr()
        assert ("atlas of" in captured.err) == (not answers)
        answers.append(json.loads(captured.out))
    assert (tmp_path / "new.npz").exists()
    assert answers[0]["pose"] == answers[1]["pose"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--index", "2"], "there is no scan 2"),
        (["--index", "0"], "0 of 180 rays met something"),
        (["--index", "1", "--topic", "/scan"], "only rosbags have topics"),
        (["--index", "1", "--picture", "no/a.png"], "no/a.png"),
        (["--index", "1", "--atlas", "MAP"], "cannot read a scan atlas"),
        (["--index", "1", "--atlas", "new.npz", "--spacing", "-1"], "spacing must be"),
    ],
)
def test_errors_are_one_line_and_status_two(recorded, capsys, options, message):
    options = [str(recorded / "log.npz") if word == "MAP" else word for word in options]
    assert localise(recorded, *options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fsmsm: error: ")
    assert message in line


def match(folder, *options, near=NEAR):
    files = [str(folder / "map.yaml"), str(folder / "log.npz")]
    initial = ["--initial", *(f"{number:.4f}" for number in near)]
    return cli.main(["match", *files, *initial, "--index", "1", *options])


def test_match_says_what_the_scan_makes_of_an_estimate(recorded, capsys, tmp_path):
    assert match(recorded) == 0
    out = capsys.readouterr().out
    pose = re.search(r"pose      x (\S+) m ± \S+, y (\S+) m ± \S+, heading (\S+)°", out)
    found = np.array([float(group) for group in pose.groups()])
    np.testing.assert_allclose(found[:2], TRUTH[:2], atol=0.03)
    np.testing.assert_allclose(np.deg2rad(found[2]), TRUTH[2], atol=0.01)
    caer = re.search(r"converged in \d+ iterations.*CAER (\S+) → (\S+) cm", out)
    before, after = (float(group) for group in caer.groups())
    assert after < before / 5
    for word in ("initial   x 7.620 m", "1σ", " ms", "picture   match.png"):
        assert word in out
    assert (tmp_path / "match.png").read_bytes().startswith(b"\x89PNG")


def test_match_answers_programs_too(recorded, capsys, tmp_path):
    assert match(recorded, "--json", "--picture", "none") == 0
    answer = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(answer["pose"], TRUTH, atol=0.03)
    assert np.shape(answer["covariance"]) == (3, 3)
    assert answer["converged"] is True
    assert answer["caer_per_ray"] < answer["caer_before"]
    assert answer["seconds"].keys() == {"first_match", "match"}
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"near": (70, 4, 40)}, "off the map or inside a wall"),
        ({"near": (float("nan"), 4, 40)}, "finite numbers"),
        ({"rays": 3}, "at least 8 rays"),
    ],
)
def test_an_estimate_that_helps_nobody_is_an_error(recorded, capsys, options, message):
    rays = ["--rays", str(options.pop("rays", 360))]
    assert match(recorded, *rays, **options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fsmsm: error: ")
    assert message in line


def test_match_as_published_is_told_the_noise(recorded, monkeypatch):
    configs = []

    def give_up(world, scan, pose, config, *, rays):
        configs.append(config)
        raise ValueError("seen enough")

    monkeypatch.setattr(import_module("fsmsm_jax.cli.match"), "match_scan", give_up)
    assert match(recorded, "--published", "0.05", near=(-7.0, 3.9, 62.0)) == 2
    assert configs[0].levels == (2, 3, 4, 5)
    assert configs[0].finish == 0
    np.testing.assert_allclose(configs[0].caer_limit, 4 * 0.05 + 0.001, rtol=1e-6)


def test_match_needs_an_estimate(recorded, capsys):
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["match", str(recorded / "map.yaml"), str(recorded / "log.npz")])
    assert exit_info.value.code == 2
    assert "--initial" in capsys.readouterr().err


def test_missing_files_are_named(recorded, capsys):
    log = str(recorded / "log.npz")
    for files in (["missing.yaml", log], [str(recorded / "map.yaml"), "missing.log"]):
        assert cli.main(["localise", *files]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("fsmsm: error: ")
        assert "missing." in line


def test_a_command_imports_no_other_and_all_are_in_the_help(capsys):
    code = (
        "import sys; from fsmsm_jax import cli; cli.main(['localise', 'no', 'no']);"
        "print(*sorted(m for m in sys.modules if m.startswith('fsmsm_jax.cli.')));"
        "print('matplotlib' in sys.modules, 'scipy.stats' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    modules, heavy = run.stdout.splitlines()
    assert modules == "fsmsm_jax.cli.console fsmsm_jax.cli.localise"
    assert heavy == "False False"
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["--help"])
    assert exit_info.value.code == 0
    out = capsys.readouterr().out
    assert all(f"• {name}" in out for name in cli.COMMANDS)


def test_the_shell_gets_all_output_and_the_status():
    code = "import sys; from fsmsm_jax import cli; print('told'); cli.run()"
    command = [sys.executable, "-c", code, "localise", "missing.yaml", "missing.npz"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stdout == "told\n"
    assert run.stderr.startswith("fsmsm: error: ")


def test_wrong_usage_exits_with_status_two(capsys):
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["localise"])
    assert exit_info.value.code == 2


def test_help_names_every_option(capsys):
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["localise", "--help"])
    assert exit_info.value.code == 0
    out = capsys.readouterr().out
    for option in (
        "MAP",
        "LOG",
        "--index",
        "--topic",
        "--json",
        "--picture",
        "--spacing",
        "--atlas",
    ):
        assert option in out


def test_export_for_another_machine_is_written_and_not_run(recorded, capsys):
    files = [str(recorded / "map.yaml"), str(recorded / "log.npz"), "robot.fsmsm"]
    other = "cpu" if platform_here() == "cuda" else "cuda"
    assert cli.main(["export", *files, "--index", "1", "--platform", other]) == 0
    out = capsys.readouterr().out
    assert re.search(r"tracker   robot.fsmsm, \S+ MB, for 180 rays over 358°", out)
    assert "loaded" not in out
    with pytest.raises(ValueError, match=f"is for {other}, this is"):
        load_tracker("robot.fsmsm")


@pytest.mark.slow
def test_demo_ends_with_a_picture(capsys, tmp_path):
    assert cli.main(["demo", "--seed", "2", "--picture", "lost.png"]) == 0
    out = capsys.readouterr().out
    assert "truth     x" in out
    assert "picture   lost.png" in out
    assert (tmp_path / "lost.png").stat().st_size > 50_000


def test_compiled_programs_are_kept_in_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.delenv("FSMSM_NO_CACHE")
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    set_to = {}
    monkeypatch.setattr(jax.config, "update", set_to.__setitem__)
    cli.main(["localise", "missing.yaml", "missing.npz"])
    assert set_to["jax_compilation_cache_dir"] == str(tmp_path / "cache" / "fsmsm_jax")
    assert (tmp_path / "cache" / "fsmsm_jax").is_dir()
    set_to.clear()
    monkeypatch.setenv("FSMSM_NO_CACHE", "1")
    cli.main(["localise", "missing.yaml", "missing.npz"])
    assert not set_to
