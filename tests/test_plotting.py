from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.geometry import transform_points
from fsmsm_jax.localisation.settle import Candidates, Localisation
from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

figure = import_module("matplotlib.figure")  # not at fsmsm_jax's import
plotting = import_module("fsmsm_jax.plotting")

ORIGIN = (-3.0, 2.0, 0.5)
ROOM = PolygonMap.from_outlines([[1, 1], [9, 1], [9, 4], [5, 4], [5, 6], [1, 6]])


@pytest.fixture
def ax():
    return figure.Figure(figsize=(5, 5)).add_subplot()


def turned_grid():
    """An 8 × 6 m room in unknown space, in a map whose origin is turned."""
    cells = np.full((100, 120), -1)
    cells[20:80, 20:100] = 100
    cells[21:79, 21:99] = 0
    cells[50:60, 60:70] = 100
    return OccupancyGrid.from_cells(cells, 0.1, ORIGIN)


def scene(world, pose, confident=True):
    lidar = Lidar.create(90, 1.5 * np.pi, range_max=5.0, noise=0.01)
    scan = lidar.measure(jax.random.key(0), raycast(world, pose, lidar.bearings, 5.0))
    poses = jnp.stack([pose, jnp.array([2.0, 2.0, 1.0])])
    caer = jnp.array([0.02, 0.3])
    covariance = jnp.diag(jnp.array([0.01, 0.02, 0.001])) ** 2
    return scan, Localisation(
        pose=pose,
        covariance=covariance,
        caer_per_ray=caer[0],
        explained=jnp.asarray(0.9),
        confident=jnp.asarray(confident),
        candidates=Candidates(poses, -caer, -caer, caer),
    )


def render(ax):
    """The picture in 0..255, row 0 at the bottom."""
    canvas = import_module("matplotlib.backends.backend_agg").FigureCanvasAgg(ax.figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[::-1, :, :3].astype(float)


def rgb(colour):
    return 255 * np.array(import_module("matplotlib.colors").to_rgb(colour))


def test_turned_grid_is_drawn_where_it_lies(ax):
    world = turned_grid()
    plotting.plot_world(ax, world)
    ax.set_axis_off()
    for cell, colour in (
        ((40.0, 40.0), "white"),
        ((65.0, 55.0), plotting.WALL),
        ((18.0, 50.0), plotting.UNKNOWN),
    ):
        image = render(ax)
        column, row = ax.transData.transform(np.asarray(world.to_map(jnp.array(cell))))
        np.testing.assert_allclose(image[int(row), int(column)], rgb(colour), atol=2)


def test_frame_holds_the_free_space_and_little_else(ax):
    world = turned_grid()
    plotting.plot_world(ax, world)
    corners = world.to_map(jnp.array([[21.0, 21], [99, 21], [99, 79], [21, 79]]))
    for limits, values in zip((ax.get_xlim(), ax.get_ylim()), corners.T, strict=True):
        assert limits[0] <= values.min() <= limits[0] + 0.8
        assert limits[1] - 0.8 <= values.max() <= limits[1]


def test_map_without_free_space_is_still_drawn(ax):
    plotting.plot_world(ax, OccupancyGrid.from_cells(np.full((4, 6), -1), 0.5))
    assert ax.get_xlim()[0] < 0.5 < 2.5 < ax.get_xlim()[1]


def test_polygon_walls_are_lines(ax):
    lines = plotting.plot_world(ax, ROOM)
    segments = np.array(lines.get_segments())
    np.testing.assert_allclose(segments[:, 0], ROOM.start)
    np.testing.assert_allclose(segments[:, 1], ROOM.end)
    np.testing.assert_allclose(ax.get_xlim(), [0.5, 9.5], atol=0.01)


def test_scan_shows_its_echoes_only(ax):
    pose = jnp.array([2.0, 2.0, 0.7])
    scan, _ = scene(ROOM, pose)
    assert 0 < scan.echo.sum() < scan.echo.size
    rays, ends = plotting.plot_scan(ax, scan, pose)
    points = np.asarray(transform_points(pose, scan.points))[np.asarray(scan.echo)]
    np.testing.assert_allclose(ends.get_offsets(), points, rtol=1e-6)
    np.testing.assert_allclose(
        [s[0] for s in rays.get_segments()], [[2, 2]] * len(points)
    )


def test_pose_points_along_its_heading(ax):
    arrow, label = plotting.plot_pose(ax, jnp.array([1.0, 2.0, np.pi / 2]), label="7")
    np.testing.assert_allclose(arrow.get_xydata(), [[1, 2]])
    assert label.get_text() == "7"
    label.remove()
    ax.set(xlim=(0, 2), ylim=(1, 3))
    ax.set_axis_off()
    painted = np.abs(render(ax) - rgb(plotting.POSE)).max(axis=-1) < 40
    offsets = np.argwhere(painted)[:, ::-1] - ax.transData.transform((1, 2))
    tip, tail = (offsets[offsets[:, 1] == end(offsets[:, 1])] for end in (max, min))
    assert np.abs(tip[:, 0]).max() < 2 < np.abs(tail[:, 0]).max()


def test_ellipse_has_the_axes_of_the_covariance(ax):
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([0.3**2, 0.1**2]) @ turn.T
    ellipse = plotting.plot_covariance(ax, jnp.ones(3), jnp.asarray(covariance), 2.0)
    assert ellipse.width == pytest.approx(2 * 2 * 0.3, rel=1e-4)
    assert ellipse.height == pytest.approx(2 * 2 * 0.1, rel=1e-4)
    assert ellipse.angle % 180 == pytest.approx(np.rad2deg(0.4), abs=0.01)


@pytest.mark.parametrize("confident", [True, False])
@pytest.mark.parametrize("world", [ROOM, turned_grid()], ids=["polygons", "grid"])
def test_localisation_says_its_verdict(tmp_path, ax, world, confident):
    pose = jnp.array([2.5, 2.5, -1.0]) if world is ROOM else jnp.array([-0.5, 7.5, 1.0])
    scan, result = scene(world, pose, confident)
    building, room, close = plotting.plot_localisation(
        ax, world, scan, result, pose + 0.01
    )
    title = building.get_title(loc="left")
    assert title.startswith("Confident: x " if confident else "Not confident: x ")
    labels = {
        text.get_text() for view in (building, room, close) for text in view.texts
    }
    assert {"2", "truth", "1, 2, 3 σ"} <= labels
    assert ("1" in labels) == (not confident)
    assert any("CAER 2.0 cm per ray" in label for label in labels)
    spans = [np.ptp(view.get_xlim()) for view in (building, room, close)]
    assert spans[0] > spans[1] > spans[2] > 0.05
    ax.figure.savefig(tmp_path / "picture.png", bbox_inches="tight")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_lone_candidate_far_truth_and_boundless_covariance(ax):
    scan, result = scene(ROOM, jnp.array([2.0, 2.0, 0.0]))
    result = result._replace(
        covariance=jnp.diag(jnp.full(3, jnp.inf)),
        candidates=result.candidates._replace(scores=jnp.array([0.0, -jnp.inf])),
    )
    building, *_ = plotting.plot_localisation(
        ax, ROOM, scan, result, jnp.array([8.0, 2, 0])
    )
    labels = [text.get_text() for text in building.texts]
    assert "truth" in labels
    assert "2" not in labels


# --- The thesis's figures -----------------------------------------------------------


def test_boxes_are_the_quartiles_in_the_axis_unit_and_published_marks_are_as_given(ax):
    sample = np.arange(1, 102) * 1e-3
    errors = {"ours": [sample, 2 * sample], "fm": [sample, sample]}
    boxes = plotting.plot_errors(
        ax, errors, ["a", "b"], {"fm": [(20.0, 30.0), (40.0, 50.0)]}
    )
    assert list(boxes) == ["ours", "fm"]
    for box, middle in zip(boxes["ours"]["medians"], (51.0, 102.0), strict=True):
        np.testing.assert_allclose(box.get_ydata(), middle)
    low, high = boxes["fm"]["whiskers"][0], boxes["fm"]["whiskers"][1]
    assert low.get_ydata().min() == pytest.approx(6.0)
    assert high.get_ydata().max() == pytest.approx(96.0)
    published = [line for line in ax.lines if line.get_marker() in ("_", "x")]
    assert [list(line.get_ydata()) for line in published] == [[20, 40], [30, 50]]
    ours, theirs = (boxes[name]["medians"][0].get_xdata().mean() for name in boxes)
    assert ours < 0 < theirs < published[0].get_xdata()[0] < 0.5
    assert [text.get_text() for text in ax.get_xticklabels()] == ["a", "b"]


def test_the_most_similar_candidate_of_each_case_is_the_one_in_colour(ax):
    error = np.array([[-0.002, 0.001, 0.004], [0.02, 0.01, -0.03]])
    similarity = np.array([[0.9, 0.99, 1.0], [0.7, 0.5, 0.6]])
    every, chosen = plotting.plot_similarity(ax, error, similarity)
    np.testing.assert_allclose(chosen.get_offsets(), [[4, 1e-8], [20, 0.3]], rtol=1e-6)
    assert len(every.get_offsets()) == 6
    assert (every.get_offsets() > 0).all()  # on logarithmic axes


def test_caer_is_counted_and_its_medians_follow_it(ax):
    error = np.linspace(0.001, 0.8, 4000)
    caer = 0.1 + error
    caer[::100] = np.inf  # no valid ray: not drawn
    mesh, line = plotting.plot_caer(ax, error, caer, bands=8)
    assert mesh.get_array().sum() == pytest.approx(0.99 * 4000, rel=0.005)
    np.testing.assert_allclose(line.get_ydata(), 0.1 + line.get_xdata(), atol=0.01)


def test_lonely_bands_have_no_median(ax):
    error = np.append(np.full(50, 0.1), [0.8])
    _, line = plotting.plot_caer(ax, error, np.linspace(0.1, 0.2, 51), bands=4)
    assert np.isfinite(line.get_ydata()).tolist() == [True, False, False, False]


def test_convergence_shows_the_median_and_not_too_many_cases(ax):
    errors = np.outer(np.arange(1, 202), 0.5 ** np.arange(5))
    trails, median = plotting.plot_convergence(ax, errors, "walk", scale=1e3)
    np.testing.assert_allclose(median.get_ydata(), 101e3 * 0.5 ** np.arange(5))
    assert 10 < len(trails.get_segments()) <= 60
    assert median.get_label() == "walk"
    assert ax.get_yscale() == "log"


def test_path_starts_in_its_ring(ax):
    poses = jnp.array([[4.0, -4.0, 0.1], [2.0, -2.0, 0.2], [1.0, -1.0, 0.3]])
    way, ring = plotting.plot_path(ax, poses)
    np.testing.assert_allclose(way.get_xydata(), poses[:, :2])
    np.testing.assert_allclose(ring.get_xydata(), poses[:1, :2])


def test_sweep_has_its_intervals_and_the_published_values_it_covers(ax):
    y = np.array([8.0, 4.0, 2.0])
    low, high = np.array([6.0, -1.0, -np.inf]), np.array([9.0, 7.0, np.inf])
    drawn = plotting.plot_sweep(
        ax, range(3), y, "uf", interval=(low, high), published=[9.0, 5.0, 3.0, 1.0]
    )
    assert drawn.has_yerr
    ends = [segment[:, 1].tolist() for segment in drawn[2][0].get_segments()]
    assert ends == [[6, 9], [4, 7], [2, 2]]  # what cannot be drawn is not
    (theirs,) = (line for line in ax.lines if line.get_label() == "uf, thesis")
    assert theirs.get_ydata().tolist() == [9, 5, 3]


def test_short_logarithmic_axes_have_numbers_and_no_exponents(ax):
    plotting.plot_sweep(ax, [0, 1], [0.4, 4.0])
    ax.figure.savefig(import_module("io").BytesIO())
    labels = {text.get_text() for text in ax.get_yticklabels(which="both")}
    assert {"0.5", "1", "2"} <= labels
    assert not any("^" in label for label in labels)
