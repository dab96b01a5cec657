"""Reading recordings: files made by hand, as the format's description gives them, and each kind of damage by name."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import read_recording
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

POSE = "1 0 0 10 0 1 0 20 0 0 1 -30 0 0 0 1 "


class HandMadeFile:
    """The minimal example of the format's description, to be bent by tests."""

    def __init__(self) -> None:
        self.fields = {
            "ObjectType": "Image",
            "NDims": "3",
            "AnatomicalOrientation": "RAI",
            "BinaryData": "True",
            "BinaryDataByteOrderMSB": "False",
            "CenterOfRotation": "0 0 0",
            "CompressedData": "False",
            "DimSize": "4 1 2",
            "ElementNumberOfChannels": "1",
            "ElementSpacing": "0.0385 1 1",
            "ElementType": "MET_SHORT",
            "Kinds": "domain domain list",
            "Offset": "0 0 0",
            "TransformMatrix": "1 0 0 0 1 0 0 0 1",
            "UltrasoundImageOrientation": "FM",
            "UltrasoundImageType": "RF_REAL",
            "SamplingFrequencyHz": "20000000",
            "TransducerFrequencyHz": "5e6",
            "ForerunLengthMm": "12.5",
            "ForerunSpeedOfSoundMps": "2730",
            "Seq_Frame0000_FrameNumber": "1000",
            "Seq_Frame0000_ProbeToReferenceTransform": POSE,
            "Seq_Frame0000_ProbeToReferenceTransformStatus": "OK",
            "Seq_Frame0000_PalpationPoint": "3",
            "Seq_Frame0000_Timestamp": "0.000000",
            "Seq_Frame0000_UnfilteredTimestamp": "0.000300",
            "Seq_Frame0000_ImageStatus": "OK",
            "Seq_Frame0001_FrameNumber": "1003",
            "Seq_Frame0001_ProbeToReferenceTransformStatus": "MISSING",
            "Seq_Frame0001_Timestamp": "0.050000",
            "Seq_Frame0001_ImageStatus": "OK",
        }
        self.pixels = np.arange(-4, 4, dtype="<i2").tobytes()
        self.data_file = "LOCAL"

    def save(self, path: Path) -> Path:
        lines = [f"{name} = {value}\n" for name, value in self.fields.items()] + [f"ElementDataFile = {self.data_file}\n"]
        header = "".join(lines).encode("ascii")
        if self.data_file == "LOCAL":
            path.write_bytes(header + self.pixels)
        else:
            path.write_bytes(header)
            path.with_name(self.data_file).write_bytes(self.pixels)
        return path

    def drop(self, name: str) -> None:
        del self.fields[name]


@pytest.fixture
def a_file():
    return HandMadeFile()


@pytest.fixture
def a_path(tmp_path):
    return tmp_path / "a.igs.mha"


def test_the_minimal_example_is_read(a_file, a_path):
    recording = read_recording(a_file.save(a_path))
    assert recording.lines.tolist() == [[-4, -3, -2, -1], [0, 1, 2, 3]]
    assert recording.lines.dtype == np.int16
    assert recording.statuses == ("OK", "MISSING")
    np.testing.assert_array_equal(recording.probe_to_reference[0][:3, 3], [10, 20, -30])
    assert np.isnan(recording.probe_to_reference[1]).all()
    assert recording.timestamps_s.tolist() == [0.0, 0.05]
    assert recording.palpation_points.tolist() == [3, -1]
    acquisition = recording.acquisition
    assert (acquisition.sampling_hz, acquisition.transducer_hz) == (20e6, 5e6)
    assert (acquisition.forerun_length_mm, acquisition.forerun_speed_m_s) == (12.5, 2730)


def test_poses_are_row_by_row(a_file, a_path):
    a_file.fields["Seq_Frame0000_ProbeToReferenceTransform"] = "0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1"
    pose = read_recording(a_file.save(a_path)).probe_to_reference[0]
    assert pose.tolist() == [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def test_names_are_matched_without_case_and_values_trimmed(a_file, a_path):
    a_file.fields = {name if name == "ObjectType" else name.upper(): f"{value}   " for name, value in a_file.fields.items()}
    recording = read_recording(a_file.save(a_path))
    assert recording.statuses == ("OK", "MISSING")
    assert recording.acquisition.sampling_hz == 20e6


def test_pixels_in_a_file_of_their_own(a_file, tmp_path):
    a_file.data_file = "a.raw"
    assert read_recording(a_file.save(tmp_path / "a.mhd")).lines[1].tolist() == [0, 1, 2, 3]


def test_compressed_pixels_are_one_zlib_stream(a_file, a_path):
    whole = read_recording(a_file.save(a_path)).lines
    a_file.pixels = zlib.compress(a_file.pixels)
    a_file.fields.update(CompressedData="True", CompressedDataSize=str(len(a_file.pixels)))
    assert np.array_equal(read_recording(a_file.save(a_path)).lines, whole)


def test_an_old_file_without_statuses_is_ok_where_it_has_poses(a_file, a_path):
    a_file.drop("Seq_Frame0000_ProbeToReferenceTransformStatus")
    a_file.drop("Seq_Frame0001_ProbeToReferenceTransformStatus")
    assert read_recording(a_file.save(a_path)).statuses == ("OK", "MISSING")


@pytest.mark.parametrize("status", ["INVALID", "MISSING", "OUT_OF_VIEW", "OUT_OF_VOLUME", "REQ_TIMEOUT"])
def test_a_pose_whose_status_is_not_ok_is_not_a_pose(a_file, a_path, status):
    a_file.fields["Seq_Frame0000_ProbeToReferenceTransformStatus"] = status
    recording = read_recording(a_file.save(a_path), require_probe=False)
    assert recording.statuses[0] == status
    assert np.isnan(recording.probe_to_reference[0]).all()


def test_ok_without_a_pose_is_missing(a_file, a_path):
    a_file.fields["Seq_Frame0001_ProbeToReferenceTransformStatus"] = "OK"
    assert read_recording(a_file.save(a_path)).statuses == ("OK", "MISSING")


@pytest.mark.parametrize("value", ["nan", "-NaN", "inf"])
def test_ok_with_a_pose_that_is_not_finite_is_missing_in_that_frame_alone(a_file, a_path, value):
    a_file.fields["Seq_Frame0000_ProbeToReferenceTransform"] = POSE.replace("20", value)
    a_file.fields["Seq_Frame0001_ProbeToReferenceTransform"] = POSE
    a_file.fields["Seq_Frame0001_ProbeToReferenceTransformStatus"] = "OK"
    recording = read_recording(a_file.save(a_path))
    assert recording.statuses == ("MISSING", "OK")
    assert np.isnan(recording.probe_to_reference[0]).all()
    np.testing.assert_array_equal(recording.probe_to_reference[1][:3, 3], [10, 20, -30])


def test_a_frame_whose_line_is_invalid_never_becomes_a_point(a_file, a_path):
    a_file.fields["Seq_Frame0000_ImageStatus"] = "INVALID"
    recording = read_recording(a_file.save(a_path))
    assert recording.statuses == ("INVALID", "MISSING")
    assert np.isnan(recording.probe_to_reference).all()


def test_other_tools_and_fields_are_kept(a_file, a_path):
    a_file.fields = {"ObjectType": "Image", "NDims": "3", "CranioNavVersion": "1.2", **a_file.fields}
    a_file.fields["Seq_Frame0001_StylusToTrackerTransform"] = POSE
    recording = read_recording(a_file.save(a_path))
    assert recording.fields == {"CranioNavVersion": "1.2"}
    assert recording.other_statuses == {"StylusToTracker": ("MISSING", "OK")}
    assert np.isfinite(recording.other_transforms["StylusToTracker"][1]).all()


@pytest.mark.parametrize(
    ("kind", "numpy_kind"), [("MET_CHAR", "i1"), ("MET_UCHAR", "u1"), ("MET_INT", "i4"), ("MET_FLOAT", "f4")]
)
def test_other_sample_types_are_read_without_loss(a_file, a_path, kind, numpy_kind):
    a_file.fields["ElementType"] = kind
    a_file.pixels = np.arange(8).astype(f"<{numpy_kind}").tobytes()
    assert read_recording(a_file.save(a_path)).lines.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_big_endian_samples_are_swapped(a_file, a_path):
    a_file.fields["BinaryDataByteOrderMSB"] = "True"
    a_file.pixels = np.arange(8, dtype=">i2").tobytes()
    assert read_recording(a_file.save(a_path)).lines[1].tolist() == [4, 5, 6, 7]


def test_poses_only(a_file, a_path):
    a_file.fields.update(DimSize="0 0 2", ElementType="MET_UCHAR")
    for name in ("SamplingFrequencyHz", "UltrasoundImageType", "UltrasoundImageOrientation"):
        a_file.drop(name)
    a_file.pixels = b""
    recording = read_recording(a_file.save(a_path))
    assert recording.lines.shape == (2, 0)
    assert len(recording) == 2
    assert np.isnan(recording.acquisition.sampling_hz)


DAMAGE = {
    "NDims = 4": ({"NDims": "4", "DimSize": "4 1 1 2"}, "NDims is 4"),
    "sizes missing": ({"DimSize": "4 1"}, "DimSize is '4 1'"),
    "several lines a frame": ({"DimSize": "2 2 2"}, "2 lines a frame"),
    "frame axis first": ({"Kinds": "list domain domain"}, "frame axis must be the last"),
    "an image, not RF": ({"UltrasoundImageType": "BRIGHTNESS"}, "UltrasoundImageType is BRIGHTNESS, expected RF_REAL"),
    "B-mode orientation": ({"UltrasoundImageOrientation": "MF"}, "UltrasoundImageOrientation is MF, expected FM"),
    "several channels": ({"ElementNumberOfChannels": "3"}, "ElementNumberOfChannels is 3"),
    "unknown sample type": ({"ElementType": "MET_LONG_LONG"}, "MET_LONG_LONG cannot be read"),
    "text pixels": ({"BinaryData": "False"}, "BinaryData is not True"),
    "compressed without size": ({"CompressedData": "True"}, "CompressedDataSize is missing"),
    "compressed and damaged": ({"CompressedData": "True", "CompressedDataSize": "16"}, "compressed pixels are damaged"),
    "compressed and cut": ({"CompressedData": "True", "CompressedDataSize": "90"}, "16 of 90 bytes"),
    "sampling frequency in MHz": ({"SamplingFrequencyHz": "20"}, "SamplingFrequencyHz is 20; expected 100000"),
    "sampling frequency no number": ({"SamplingFrequencyHz": "fast"}, "'fast', expected a number"),
    "sampling frequency NaN": ({"SamplingFrequencyHz": "nan"}, "SamplingFrequencyHz is nan"),
    "transducer above Nyquist": ({"TransducerFrequencyHz": "15e6"}, "TransducerFrequencyHz is 15e6"),
    "forerun without speed": ({"ForerunSpeedOfSoundMps": "0"}, "ForerunSpeedOfSoundMps is 0"),
    "fifteen numbers": ({"Seq_Frame0000_ProbeToReferenceTransform": POSE[2:]}, "frame 0: .* 15 numbers, expected 16"),
    "a word in a pose": (
        {"Seq_Frame0000_ProbeToReferenceTransform": POSE.replace("20", "xx")},
        "ProbeToReferenceTransform: .*xx",
    ),
    "transposed pose": (
        {"Seq_Frame0000_ProbeToReferenceTransform": "1 0 0 0 0 1 0 0 0 0 1 0 10 20 30 1"},
        "last row not 0 0 0 1",
    ),
    "scaled pose": ({"Seq_Frame0000_ProbeToReferenceTransform": POSE.replace("1 0 0 10", "2 0 0 10")}, "not rigid"),
    "mirrored pose": ({"Seq_Frame0000_ProbeToReferenceTransform": POSE.replace("1 0 0 10", "-1 0 0 10")}, "mirrors"),
    "scaled pose after one that is not finite": (
        {
            "Seq_Frame0000_ProbeToReferenceTransform": POSE.replace("20", "nan"),
            "Seq_Frame0001_ProbeToReferenceTransform": POSE.replace("1 0 0 10", "2 0 0 10"),
            "Seq_Frame0001_ProbeToReferenceTransformStatus": "OK",
        },
        "frame 1: .* not rigid",
    ),
    "pose far away": ({"Seq_Frame0000_ProbeToReferenceTransform": POSE.replace("20", "2e8")}, "more than 100 m away"),
    "a time that is no number": ({"Seq_Frame0001_Timestamp": "later"}, "Timestamp: .*later"),
    "a time that is NaN": ({"Seq_Frame0001_Timestamp": "nan"}, "frame 1: Timestamp is not a finite number"),
    "time runs back": ({"Seq_Frame0001_Timestamp": "-1"}, "frame 1: Timestamp goes back"),
    "palpation point no number": ({"Seq_Frame0000_PalpationPoint": "two"}, "frame 0: PalpationPoint is 'two'"),
    "no frame at all": ({"DimSize": "4 1 0"}, "do not fit|no whole frame|fields for"),
    "fields beyond the frames": ({"Seq_Frame0007_Timestamp": "9"}, "fields for 8 frames but DimSize announces 2"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_refused_by_name(a_file, a_path, name):
    changes, message = DAMAGE[name]
    a_file.fields.update(changes)
    with pytest.raises(InputError, match=message) as refusal:
        read_recording(a_file.save(a_path))
    assert str(a_path) in str(refusal.value)


ABSENT = {
    "SamplingFrequencyHz": "SamplingFrequencyHz is missing",
    "TransducerFrequencyHz": "TransducerFrequencyHz is missing",
    "UltrasoundImageType": "UltrasoundImageType is BRIGHTNESS",
    "UltrasoundImageOrientation": "UltrasoundImageOrientation is missing",
    "NDims": "NDims is missing",
    "DimSize": "DimSize is missing",
    "ElementType": "ElementType is missing",
    "Seq_Frame0001_Timestamp": "frame 1 has no Timestamp",
    "Seq_Frame0000_ProbeToReferenceTransform": "no frame has a ProbeToReferenceTransform",
}


@pytest.mark.parametrize("name", ABSENT)
def test_what_is_absent_is_refused_by_name(a_file, a_path, name):
    a_file.drop(name)
    with pytest.raises(InputError, match=ABSENT[name]):
        read_recording(a_file.save(a_path))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_recording(tmp_path / "none.igs.mha")


@pytest.mark.parametrize("content", [b"", b"NRRD0004\n", b"\x89PNG\r\n", b"NDims = 3\nObjectType = Image\n"])
def test_another_kind_of_file_is_refused(a_path, content):
    a_path.write_bytes(content)
    with pytest.raises(InputError, match="not a sequence metafile"):
        read_recording(a_path)


def test_a_missing_pixel_file_is_refused(a_file, tmp_path):
    a_file.data_file = "a.raw"
    path = a_file.save(tmp_path / "a.mhd")
    (tmp_path / "a.raw").unlink()
    with pytest.raises(InputError, match=r"pixel file a\.raw is missing"):
        read_recording(path)


@pytest.mark.parametrize("name", ["../a.raw", "LIST", "a%03d.raw 1 2 1"])
def test_pixels_from_elsewhere_are_refused(a_file, tmp_path, name):
    path = a_file.save(tmp_path / "a.mhd")
    path.write_bytes(path.read_bytes().partition(b"ElementDataFile")[0] + f"ElementDataFile = {name}\n".encode())
    with pytest.raises(InputError, match="one file in the same folder"):
        read_recording(path)


@pytest.mark.parametrize(("size", "whole"), [(15, 1), (8, 1), (7, 0), (0, 0)])
def test_a_cut_in_a_frame_is_refused_and_says_how_many_are_whole(a_file, a_path, size, whole):
    a_file.pixels = a_file.pixels[:size]
    with pytest.raises(InputError, match=f"2 frames announced, {whole} are whole"):
        read_recording(a_file.save(a_path))


def test_whole_frames_of_a_cut_file_are_kept_when_asked(a_file, a_path):
    a_file.pixels = a_file.pixels[:15]
    recording = read_recording(a_file.save(a_path), allow_truncated=True)
    assert recording.lines.tolist() == [[-4, -3, -2, -1]]
    assert len(recording.statuses) == len(recording.timestamps_s) == len(recording.palpation_points) == 1


@pytest.mark.parametrize("extra", [b"x", b"12345678"])
def test_bytes_too_many_are_refused(a_file, a_path, extra):
    a_file.pixels += extra
    with pytest.raises(InputError, match="do not fit the header"):
        read_recording(a_file.save(a_path))


@pytest.mark.parametrize("value", [40000, 0.5, np.nan])
def test_samples_that_would_lose_are_refused(a_file, a_path, value):
    a_file.fields["ElementType"] = "MET_FLOAT"
    a_file.pixels = np.full(8, value, dtype="<f4").tobytes()
    with pytest.raises(InputError, match="do not fit 16-bit whole numbers"):
        read_recording(a_file.save(a_path))


@given(st.data())
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_file_is_read_or_refused_never_a_crash(tmp_path, data):
    path = HandMadeFile().save(tmp_path / "h.igs.mha")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            content[place] = data.draw(st.integers(0, 255))
        else:
            del content[place : place + data.draw(st.integers(1, 40))]
    path.write_bytes(content)
    try:
        recording = read_recording(path)
    except InputError:
        return
    usable = np.array([status == "OK" for status in recording.statuses])
    assert np.array_equal(np.isfinite(recording.probe_to_reference).all(axis=(1, 2)), usable)
