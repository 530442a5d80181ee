"""The recording of a localization, read back."""

from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.io.rerun.file import read_run
from magtwin.io.rerun.localization import MOST_PARTICLES, write_localization
from magtwin.run.run import Run

ROWS = 30


@pytest.fixture
def run() -> Run:
    t = np.arange(ROWS) / 5
    covariance = np.tile([0.04, 0.01, 0.0, 0.02, 0.0, 0.01], (ROWS, 1))
    covariance[3] = np.nan
    estimate = np.column_stack([t / 10, 0.1 * np.sin(t), 0 * t])
    columns = {
        "t": t,
        "b_measured_nt": 41_000 + t,
        "est_p_world_base": estimate,
        "est_yaw": 0.1 * t,
        "est_covariance": covariance,
        "est_bias_nt": 100 + t,
        "est_lost": t < 1,
    }
    from magtwin.localization.track import EST_COLUMNS

    return Run(columns, {"localizer": "own"}, EST_COLUMNS)


def chunks_of(file: Path) -> dict[str, list]:
    chunks: dict[str, list] = {}
    for chunk in RrdReader(file).stream().to_chunks():
        chunks.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return chunks


def flat(batches: list, component: str) -> np.ndarray:
    """All values of a component, in one row each."""
    parts = [batch.column(component) for batch in batches if component in batch.schema.names]
    return np.array([value for part in parts for value in part.to_pylist()], object)


def test_the_run_comes_back_and_errors_bound_and_clouds_are_in_it(run: Run, tmp_path: Path) -> None:
    truth = np.column_stack([run["est_p_world_base"][:, :2] + (0.03, 0.04), run["est_yaw"]])
    field = AnomalyMap(
        values_nt=np.full((1, 5, 9), 41_000.0), origin_m=(-1, -0.5), cell_m=(0.25, 0.25), headings_rad=[0.0]
    )
    rng = np.random.default_rng(0)
    clouds = [np.column_stack([rng.normal(0, 1, (1000, 3)), np.full(1000, 1e-3)]) for _ in range(ROWS)]
    file = tmp_path / "localize.rrd"
    bound = np.full(ROWS, 0.02)
    write_localization(
        run, file, anomaly_map=field, truth=truth, dead_reckoning=truth + 0.1, bound_m=bound, particles=clouds
    )
    back = read_run(file)
    for name in run:
        np.testing.assert_array_equal(back[name], run[name])
    assert back.spec("est_covariance").parts == run.spec("est_covariance").parts
    chunks = chunks_of(file)
    scalars = {name: flat(chunks[f"/position/{name}"], "Scalars:scalars") for name in ("error", "bound")}
    np.testing.assert_allclose(np.concatenate(scalars["error"]).astype(float), 0.05)
    np.testing.assert_allclose(np.concatenate(scalars["bound"]).astype(float), bound)
    drawn = flat(chunks["/floor/paths/particles"], "Points2D:positions")
    assert [len(cloud) for cloud in drawn] == [MOST_PARTICLES] * ROWS
    kept = {tuple(np.float32(p)) for p in clouds[5][:, :2]}
    assert {tuple(np.float32(p)) for p in drawn[5]} <= kept
    ellipses = flat(chunks["/floor/paths/ellipse"], "LineStrips2D:strips")
    assert len(ellipses) == ROWS - 1  # none where the covariance is unknown
    away = np.array(ellipses[0][0], float) - run["est_p_world_base"][0, :2]
    inverse = np.linalg.inv([[0.04, 0.01], [0.01, 0.02]])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", away, inverse, away), 4.0, rtol=1e-5)
    assert {"/floor/map", "/floor/paths/truth", "/floor/paths/dead_reckoning", "/lost/flag"} <= chunks.keys()


def test_without_truth_and_map_only_what_is_known_is_recorded(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "localize.rrd"
    write_localization(run, file)
    chunks = chunks_of(file)
    assert "/position/two_sigma" in chunks
    assert not {"/position/error", "/position/bound", "/floor/map", "/floor/paths/truth"} & chunks.keys()
    with pytest.raises(InputError, match="exists already"):
        write_localization(run, file)
    with pytest.raises(InputError, match="no estimates to record"):
        write_localization(run.select("t", "b_measured_nt"), tmp_path / "other.rrd")
