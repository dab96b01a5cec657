from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.measurement.forerun_check import forerun_remark


def lines_with_forerun(length_mm, stated_mm, count=24, one_place=False):
    rng = np.random.default_rng(0)
    time = np.arange(2800) / 60e6
    rf = rng.normal(0, 0.003, (count, len(time)))
    for delay, height in (
        (np.full(count, 2e-3 * length_mm / 2340), 0.2),
        (2e-3 * length_mm / 2340 + rng.uniform(4e-6, 16e-6, count), 0.5),
    ):
        t = time - delay[:, None]
        rf += height * np.exp(-0.5 * (t * 1e7) ** 2) * np.cos(2 * np.pi * 5e6 * t)
    where = np.zeros((count, 3)) if one_place else rng.uniform(-60, 60, (count, 3))
    return Recording(
        np.round(8000 * rf).astype(np.int16), Acquisition(60e6, 5e6, stated_mm, 2340.0),
        rigid_from_vector(np.zeros((count, 3)), where), ("OK",) * count, np.arange(count) / 50, np.full(count, -1),
    )  # fmt: skip


def test_forerun_of_another_length_is_told_with_the_length_that_fits():
    remark = forerun_remark(lines_with_forerun(17.0, 23.0))
    assert "ForerunLengthMm 23" in remark
    assert float(remark.split("as of ")[1].split(" mm")[0]) == pytest.approx(17.0, abs=0.2)


@pytest.mark.parametrize("stated", [20.0, 20.3])
def test_nothing_is_said_of_a_forerun_that_fits(stated):
    assert forerun_remark(lines_with_forerun(20.0, stated)) == ""


def test_an_echo_at_rest_under_a_resting_probe_may_be_bone():
    assert forerun_remark(lines_with_forerun(17.0, 23.0, one_place=True)) == ""


def test_an_echo_equally_deep_at_two_places_may_be_bone():
    recording = lines_with_forerun(17.0, 23.0)
    place = (np.arange(24) >= 12).astype(int)
    two = replace(recording, probe_to_reference=recording.probe_to_reference[12 * place], palpation_points=place)
    assert forerun_remark(two) == ""


def test_lines_without_a_forerun_are_not_asked():
    recording = lines_with_forerun(17.0, 23.0)
    assert forerun_remark(replace(recording, acquisition=Acquisition(60e6, 5e6))) == ""


def test_the_tail_of_the_transmit_pulse_is_no_forerun_where_the_face_is_matched_too_well_to_echo():
    recording = lines_with_forerun(200.0, 20.0)  # no echo of a face in the line at all
    time = np.arange(recording.lines.shape[1]) / 60e6
    bang = 20000 * np.exp(-time / 0.7e-6) * np.cos(2 * np.pi * 5e6 * time)
    assert forerun_remark(replace(recording, lines=(recording.lines + np.round(bang)).astype(np.int16))) == ""
