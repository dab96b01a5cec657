"""The simulated studies: what the chapter's own algorithm reaches, and that the studies count honestly."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sample_head import load_sample_head
from ModuleRegistrationLib.verification.studies import TrialRow, run_seed, run_study, summarise, write_table
from ModuleRegistrationLib.verification.study_figure import write_figure


@pytest.fixture(scope="module")
def the_sample_volume():
    try:
        return load_sample_head()
    except InputError as error:
        pytest.skip(f"sample head not to be had here: {error}")


def a_row(**changes) -> TrialRow:
    values = {
        "study": "phantom",
        "mode": "III",
        "method": "icp",
        "seed": 0,
        "status": "accepted",
        "tre_mean_mm": 1.0,
        "tre_max_mm": 2.0,
        "landmark_tre_mean_mm": 3.0,
        "predicted_tre_mm": 1.1,
        "plausibility_mean_mm": 0.4,
        "points_used": 18,
        "speed_of_sound_m_s": 1540.0,
        "duration_s": 0.5,
    }
    return TrialRow(**{**values, **changes})


def report(rows) -> float:
    """Print what a reader must know, return the mean TRE."""
    (line,) = summarise(rows)
    print(
        f"\nsimulated, mode {line.mode}, {line.method}, {line.trials} trials: "
        f"TRE {line.tre_mean_mm:.2f} +- {line.tre_sd_mm:.2f} mm "
        f"({line.tre_min_mm:.2f} to {line.tre_max_mm:.2f}), {100 * line.share_above_3_mm:.0f} % above 3 mm, "
        f"{line.failed} failed, {line.refused} refused; predicted {line.predicted_tre_mm:.2f} mm"
    )
    assert line.failed == 0
    return line.tre_mean_mm


def test_mode_iii_on_the_sample_head_stays_below_1_6_mm_in_three_trials(the_sample_volume):
    rows = run_study("phantom", trials=3, volume=the_sample_volume, modes=("III",), method="icp")
    assert report(rows) <= 1.6
    assert all(row.tre_mean_mm < row.landmark_tre_mean_mm + 1.0 for row in rows)
    again = run_seed("phantom", the_sample_volume, 1, ("III",), "icp")[0]
    assert again.tre_mean_mm == rows[1].tre_mean_mm  # the seed decides


@pytest.mark.slow
def test_mode_iii_on_the_sample_head_stays_below_1_6_mm_over_seeds_0_to_29(the_sample_volume):
    rows = run_study("phantom", trials=30, jobs=2, volume=the_sample_volume, modes=("III",), method="icp")
    assert [row.seed for row in rows] == list(range(30))
    assert report(rows) <= 1.6


@pytest.mark.slow
@pytest.mark.parametrize("study", ["phantom", "cadaver", "patient"])
def test_modes_rank_as_in_the_chapter(the_sample_volume, study):
    rows = run_study(study, trials=20, jobs=2, volume=the_sample_volume)
    mean = {line.mode: line.tre_mean_mm for line in summarise(rows)}
    print({mode: round(value, 2) for mode, value in mean.items()})
    assert mean["Ia"] < mean["III"] < mean["IIa"]
    assert mean["Ia"] < mean["Ib"]
    assert mean["IIb"] < mean["IIa"]


@pytest.mark.slow
def test_the_number_of_jobs_does_not_change_a_row(the_sample_volume):
    def run(jobs):
        rows = run_study("cadaver", 4, jobs, 5, the_sample_volume, ("IIa", "III"), "icp")
        return [(row.seed, row.mode, row.tre_mean_mm) for row in rows]

    assert run(1) == run(2)


def test_every_mode_runs_on_the_synthetic_head():
    progress = []
    rows = run_study("patient", trials=1, seed0=3, method="icp", progress=lambda done, of: progress.append((done, of)))
    assert [row.mode for row in rows] == ["Ia", "Ib", "IIa", "IIb", "III"]
    assert progress == [(1, 1)]
    assert all(math.isfinite(row.tre_mean_mm) and row.tre_mean_mm <= row.tre_max_mm for row in rows)
    assert [row.method for row in rows] == ["procrustes"] * 3 + ["icp"] * 2
    assert rows[0].tre_mean_mm < 1.5
    assert rows[2].tre_mean_mm == rows[2].landmark_tre_mean_mm


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"study": "model"}, "unknown study 'model'; studies are phantom, cadaver, patient"),
        ({"study": "phantom", "modes": ("III", "IV")}, "unknown mode IV; modes are Ia, Ib"),
        ({"study": "phantom", "modes": ()}, "none given"),
        ({"study": "phantom", "trials": 0}, "at least one trial and one job, got 0 trials"),
        ({"study": "phantom", "method": "magic"}, "unknown registration 'magic'"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_runs(arguments, says):
    with pytest.raises(InputError, match=says):
        run_study(**arguments)


def test_a_summary_counts_failures_and_large_errors_without_hiding_them():
    nan = math.nan
    rows = [a_row(seed=seed, tre_mean_mm=value) for seed, value in enumerate((0.5, 1.5, 4.0))]
    rows += [
        a_row(seed=3, tre_mean_mm=5.0, status="refused"),
        a_row(seed=4, status="failed", tre_mean_mm=nan, predicted_tre_mm=nan),
    ]
    (line,) = summarise(rows)
    assert (line.trials, line.failed, line.refused) == (5, 1, 1)
    assert line.tre_mean_mm == pytest.approx(np.mean([0.5, 1.5, 4.0, 5.0]))
    assert line.tre_sd_mm == pytest.approx(np.std([0.5, 1.5, 4.0, 5.0], ddof=1))
    assert line.share_above_3_mm == 0.5
    assert (line.tre_min_mm, line.tre_max_mm) == (0.5, 5.0)
    assert len(summarise([a_row(), a_row(mode="IIa"), a_row(study="cadaver")])) == 3


def test_a_table_reads_back_with_empty_cells_for_what_is_not_known(tmp_path):
    write_table(tmp_path / "rows.csv", [a_row(), a_row(seed=1, tre_mean_mm=math.nan, message="a, b")])
    with (tmp_path / "rows.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert float(first["tre_mean_mm"]) == 1.0
    assert second["tre_mean_mm"] == ""
    assert second["message"] == "a, b"
    with pytest.raises(InputError, match="no rows to write"):
        write_table(tmp_path / "none.csv", [])


def test_a_figure_is_drawn_of_one_study_and_refused_for_several(tmp_path):
    rows = [a_row(seed=seed, mode=mode, tre_mean_mm=1.0 + 0.1 * seed) for seed in range(5) for mode in ("IIa", "III")]
    rows.append(a_row(seed=9, status="failed", tre_mean_mm=math.nan))
    write_figure(tmp_path / "study.svg", rows)
    text = (tmp_path / "study.svg").read_text()
    assert "1 failed" in text
    assert "Simulated phantom study" in text
    for wrong in ([], [a_row(), a_row(study="cadaver")]):
        with pytest.raises(InputError, match="a figure shows one study"):
            write_figure(tmp_path / "wrong.png", wrong)
    assert not (tmp_path / "wrong.png").exists()
