import csv

import numpy as np
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.measurement.measure import LineMeasurements
from ModuleUltrasoundLib.measurement.table import write_depths_csv


def test_table_has_the_contracts_columns_and_empty_cells_where_nothing_is_known(tmp_path):
    recording = Recording(
        np.zeros((3, 4), dtype=np.int16), Acquisition(60e6, 5e6), np.full((3, 4, 4), np.nan), ("OK", "MISSING", "OK"),
        np.array([0.0, 0.02, 0.04]), np.array([2, 2, -1]),
    )  # fmt: skip
    nan = np.nan
    lines = LineMeasurements(
        depths_mm=np.array([5.25, 6.5, nan]), depth_sds_mm=np.zeros(3),
        positions_mm=np.array([[1.0, -2.0, 3.0], [nan] * 3, [nan] * 3]), covariances_mm2=np.zeros((3, 3, 3)),
        beam_directions=np.zeros((3, 3)), qualities=np.array([0.99, 0.9, 0.0]), accepted=np.array([True, False, False]),
        reasons=("", "pose missing", "no echo"), alternative_depths_mm=np.empty((3, 0)),
        alternative_probabilities=np.empty((3, 0)), skin_times_s=np.zeros(3),
        speed_of_sound_m_s=1540.0, speed_of_sound_sd_m_s=52.0,
    )  # fmt: skip
    write_depths_csv(tmp_path / "depths.csv", recording, lines)
    text = (tmp_path / "depths.csv").read_text()
    assert text.splitlines()[0] == (
        "frame,timestamp_s,palpation_point,tissue_depth_mm,bone_x_mm,bone_y_mm,bone_z_mm,quality,accepted,reason"
    )
    rows = list(csv.DictReader(text.splitlines()))
    assert [float(rows[0][f"bone_{axis}_mm"]) for axis in "xyz"] == [1.0, -2.0, 3.0]
    assert rows[1]["tissue_depth_mm"] == "6.5000"
    assert rows[1]["bone_x_mm"] == ""
    assert rows[1]["reason"] == "pose missing"
    assert rows[2]["tissue_depth_mm"] == ""
    assert rows[2]["palpation_point"] == ""
    assert [row["accepted"] for row in rows] == ["1", "0", "0"]
