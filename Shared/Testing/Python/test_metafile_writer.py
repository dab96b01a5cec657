"""Writing recordings: round trips, other readers, and what is left when the process is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid
from CranioNavLib.sequence_metafile import (
    Acquisition,
    Recording,
    RecordingWriter,
    pixels_beside,
    put_aside,
    read_recording,
    recover,
    write_recording,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

ACQUISITION = Acquisition(50e6, 5e6, 10.0, 2730.0)


def a_recording(frames: int = 12, samples: int = 64, seed: int = 0) -> Recording:
    rng = np.random.default_rng(seed)
    statuses = tuple("MISSING" if k % 5 == 2 else "OK" for k in range(frames))
    poses = rigid(Rotation.random(frames, random_state=seed).as_matrix(), rng.normal(0, 100, (frames, 3)))
    poses[[status != "OK" for status in statuses]] = np.nan
    return Recording(
        lines=rng.integers(-32768, 32768, (frames, samples)).astype(np.int16),
        acquisition=ACQUISITION,
        probe_to_reference=poses,
        statuses=statuses,
        timestamps_s=np.cumsum(rng.uniform(0.01, 0.02, frames)),
        palpation_points=rng.integers(-1, 18, frames),
        other_transforms={"StylusToTracker": poses[::-1].copy()},
        other_statuses={"StylusToTracker": statuses[::-1]},
        fields={"CranioNavTimeZero": "start of recording"},
    )


def assert_same(a: Recording, b: Recording) -> None:
    np.testing.assert_array_equal(a.lines, b.lines)
    np.testing.assert_array_equal(a.probe_to_reference, b.probe_to_reference)
    np.testing.assert_array_equal(a.timestamps_s, b.timestamps_s)
    np.testing.assert_array_equal(a.palpation_points, b.palpation_points)
    assert a.statuses == b.statuses
    assert a.acquisition == b.acquisition
    assert a.other_transforms.keys() == b.other_transforms.keys()
    for name in a.other_transforms:
        np.testing.assert_array_equal(a.other_transforms[name], b.other_transforms[name])
    assert a.other_statuses == b.other_statuses
    assert a.fields == b.fields


def feed(writer: RecordingWriter, recording: Recording, first: int = 0) -> None:
    for k in range(first, len(recording)):
        writer.append(
            float(recording.timestamps_s[k]),
            {
                "ProbeToReference": recording.probe_to_reference[k],
                "StylusToTracker": recording.other_transforms["StylusToTracker"][k],
            },
            {"ProbeToReference": recording.statuses[k], "StylusToTracker": recording.other_statuses["StylusToTracker"][k]},
            recording.lines[k],
            int(recording.palpation_points[k]),
        )


@given(st.integers(1, 30), st.integers(1, 50), st.integers(0, 100))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_recording_survives_the_disk_to_the_bit(tmp_path, frames, samples, seed):
    recording = a_recording(frames, samples, seed)
    write_recording(tmp_path / "r.igs.mha", recording)
    read = read_recording(tmp_path / "r.igs.mha")
    if all(status != "OK" for status in recording.other_statuses["StylusToTracker"]):
        recording.other_transforms.clear()  # a stream without any pose leaves only its statuses
        recording.other_statuses.clear()
        read.other_transforms.clear()
        read.other_statuses.clear()
    assert_same(read, recording)


def test_frame_by_frame_gives_the_same_as_at_once(tmp_path):
    recording = a_recording()
    with RecordingWriter(tmp_path / "b.igs.mha", 64, ACQUISITION, recording.fields) as writer:
        feed(writer, recording)
    write_recording(tmp_path / "a.igs.mha", recording)
    assert (tmp_path / "a.igs.mha").read_bytes() == (tmp_path / "b.igs.mha").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.igs.mha", "b.igs.mha"]


def test_poses_only(tmp_path):
    with RecordingWriter(tmp_path / "p.igs.mha") as writer:
        writer.append(0.0, {"ProbeToReference": np.eye(4)})
        writer.append(0.1, {"ProbeToReference": None})
    recording = read_recording(tmp_path / "p.igs.mha")
    assert recording.statuses == ("OK", "MISSING")
    assert recording.lines.shape == (2, 0)


def test_simpleitk_reads_lines_poses_and_statuses(tmp_path):
    recording = a_recording()
    write_recording(tmp_path / "r.igs.mha", recording)
    image = SimpleITK.ReadImage(str(tmp_path / "r.igs.mha"))
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image)[:, 0], recording.lines)
    assert image.GetMetaData("Seq_Frame0002_ProbeToReferenceTransformStatus") == "MISSING"
    numbers = np.array(image.GetMetaData("Seq_Frame0003_ProbeToReferenceTransform").split(), dtype=float)
    np.testing.assert_array_equal(numbers.reshape(4, 4), recording.probe_to_reference[3])


def test_what_simpleitk_writes_is_read_again(tmp_path):
    recording = a_recording()
    write_recording(tmp_path / "r.igs.mha", recording)
    SimpleITK.WriteImage(SimpleITK.ReadImage(str(tmp_path / "r.igs.mha")), str(tmp_path / "s.mha"), useCompression=True)
    again = read_recording(tmp_path / "s.mha")
    np.testing.assert_array_equal(again.lines, recording.lines)
    np.testing.assert_array_equal(again.probe_to_reference, recording.probe_to_reference)


def slicer_items(path: Path) -> int:
    """How many poses 3D Slicer's own storage node takes from the file."""
    code = (
        "import sys\nfrom slicer import vtkMRMLScene, vtkMRMLLinearTransformSequenceStorageNode\n"
        "scene = vtkMRMLScene()\nnode = scene.AddNewNodeByClass('vtkMRMLSequenceNode')\n"
        "storage = vtkMRMLLinearTransformSequenceStorageNode()\nscene.AddNode(storage)\n"
        "storage.SetFileName(sys.argv[1])\nassert storage.ReadData(node) == 1\nprint(node.GetNumberOfDataNodes())\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-1])


def test_slicer_reads_the_poses_and_leaves_out_missing_ones(tmp_path):
    recording = a_recording()
    recording.other_transforms.clear()
    recording.other_statuses.clear()
    write_recording(tmp_path / "r.seq.mha", recording)
    assert slicer_items(tmp_path / "r.seq.mha") == sum(status == "OK" for status in recording.statuses)


def test_a_growing_recording_is_readable_at_every_moment(tmp_path):
    recording = a_recording()
    writer = RecordingWriter(tmp_path / "g.igs.mha", 64, ACQUISITION)
    for k in range(len(recording)):
        writer.append(
            float(recording.timestamps_s[k]), {"ProbeToReference": recording.probe_to_reference[k]}, line=recording.lines[k]
        )
        image = SimpleITK.ReadImage(str(writer.path))
        np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image)[:, 0], recording.lines[: k + 1])
        np.testing.assert_array_equal(read_recording(writer.path).lines, recording.lines[: k + 1])
    if os.name == "posix":
        poses = sum(status == "OK" for status in recording.statuses)
        assert slicer_items(writer.path) == poses
    writer.close()
    writer.close()


def test_a_recording_of_poses_is_one_whole_file_at_every_moment(tmp_path):
    writer = RecordingWriter(tmp_path / "p.igs.mha")
    for k in range(5):
        writer.append(k / 10, {"ProbeToReference": rigid(np.eye(3), (k, 0, 0))})
        assert SimpleITK.ReadImage(str(writer.path)).GetSize()[2] == k + 1
        assert read_recording(writer.path).probe_to_reference[-1, 0, 3] == k
        assert [path.name for path in tmp_path.iterdir()] == ["p.igs.mha"]
    grown = writer.path.read_bytes()
    writer.close()
    assert writer.path.read_bytes() == grown


@pytest.mark.skipif(not hasattr(os, "pwrite"), reason="kills at a stand-in for pwrite")
@pytest.mark.parametrize("samples", [0, 4])
@pytest.mark.parametrize("survived", [0, 1, 2, 3])
def test_a_kill_between_any_two_writes_leaves_the_frames_before(tmp_path, monkeypatch, samples, survived):
    line = np.arange(4, dtype=np.int16) if samples else None
    writer = RecordingWriter(tmp_path / "k.igs.mha", samples, ACQUISITION if samples else None)
    for k in range(3):
        writer.append(k / 10, {"ProbeToReference": np.eye(4)}, line=line)
    real, done = os.pwrite, []

    def dying(handle: int, data: bytes, offset: int) -> int:
        if len(done) == survived:
            raise KeyboardInterrupt
        done.append(offset)
        return real(handle, data, offset)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(os, "pwrite", dying)
        for k in range(3, 9):
            writer.append(k / 10, {"ProbeToReference": np.eye(4)}, line=line)
    assert len(read_recording(writer.path)) == SimpleITK.ReadImage(str(writer.path)).GetSize()[2] >= 3
    assert recover(writer.path) >= 3
    assert read_recording(writer.path).timestamps_s[2] == 0.2


def test_a_line_taken_back_stays_so_when_the_process_is_killed(tmp_path):
    path = tmp_path / "t.igs.mha"
    writer, line = RecordingWriter(path, 4, ACQUISITION), np.arange(4, dtype=np.int16)
    for k in range(12):
        writer.append(k / 10, {"ProbeToReference": np.eye(4)}, line=line + k, invalid=k == 9)
        if k == 5:
            writer.mark_invalid((1, 5))
    writer.mark_invalid((11,))
    writer.mark_invalid(())
    wanted = tuple("INVALID" if k in (1, 5, 9, 11) else "OK" for k in range(12))
    for finished in (False, True):  # as a kill leaves it, and joined into one file
        assert not finished or recover(path) == 12
        recording = read_recording(path)
        assert recording.statuses == wanted
        np.testing.assert_array_equal(recording.lines, line + np.arange(12)[:, None])
        image = SimpleITK.ReadImage(str(path))
        assert image.GetSize()[2] == 12
        assert {k for k in range(12) if image.HasMetaDataKey(f"Seq_Frame{k:04d}_ImageStatus")} == {1, 5, 9, 11}
    before = path.read_bytes().partition(b"ElementDataFile")[0].decode("ascii").splitlines()
    frames = [text.split("_")[1] for text in before if text.startswith("Seq_")]
    assert frames == sorted(frames), "each stands with its frame in the end"


@pytest.mark.skipif(not hasattr(os, "pwrite"), reason="kills at a stand-in for pwrite")
@pytest.mark.parametrize("survived", [0, 1, 2])
@pytest.mark.parametrize("marked", [(1,), range(40)])
def test_a_kill_while_lines_are_taken_back_leaves_all_frames(tmp_path, monkeypatch, survived, marked):
    path = tmp_path / "k.igs.mha"
    writer = RecordingWriter(path, 4, ACQUISITION)
    for k in range(40):
        writer.append(k / 10, {"ProbeToReference": np.eye(4)}, line=np.arange(4, dtype=np.int16))
    real, done = os.pwrite, []

    def dying(handle: int, data: bytes, offset: int) -> int:
        if len(done) == survived:
            raise KeyboardInterrupt
        done.append(offset)
        return real(handle, data, offset)

    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", dying)
        if survived < 2:
            with pytest.raises(KeyboardInterrupt):
                writer.mark_invalid(marked)
        else:
            writer.mark_invalid(marked)
    statuses = read_recording(path).statuses
    assert len(statuses) == SimpleITK.ReadImage(str(path)).GetSize()[2] == 40
    assert statuses.count("INVALID") == (len(marked) if survived == 2 else 0), "all of a point or none"
    assert recover(path) == 40
    assert read_recording(path).statuses == statuses


def test_a_killed_process_loses_at_most_100_ms(tmp_path):
    code = (
        "import sys, time, numpy as np\n"
        "from CranioNavLib.sequence_metafile import RecordingWriter, Acquisition\n"
        "writer = RecordingWriter(sys.argv[1], 3200, Acquisition(50e6, 5e6))\n"
        "line = np.arange(3200, dtype=np.int16)\n"
        "k = 0\n"
        "while True:\n"
        "    writer.append(k / 60, {'ProbeToReference': np.eye(4)}, line=line + k % 100)\n"
        "    k += 1\n"
        "    print(k, flush=True)\n"
        "    time.sleep(1 / 240)\n"
    )
    target = tmp_path / "k.igs.mha"
    process = subprocess.Popen([sys.executable, "-c", code, str(target)], stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not target.exists() or target.read_bytes().count(b"_Timestamp") < 40:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)
    told = [int(line) for line in process.communicate()[0].split()]
    assert len(told) > 30
    for finished in (False, True):  # as it was left, and joined into one file
        count = recover(target) if finished else SimpleITK.ReadImage(str(target)).GetSize()[2]
        assert count >= told[-1]  # a frame is 17 ms; all that was acknowledged is there
        recording = read_recording(target)
        assert len(recording) == count
        for k in range(count):
            assert recording.lines[k, 0] == k % 100
            assert recording.timestamps_s[k] == k / 60
        assert SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(target))).shape == (count, 1, 3200)
        assert pixels_beside(target).exists() != finished


@pytest.mark.parametrize("cut", range(0, 400, 23))
def test_an_unfinished_recording_cut_anywhere_keeps_its_whole_frames(tmp_path, cut):
    recording = a_recording(6)
    writer = RecordingWriter(tmp_path / "c.igs.mha", 64, ACQUISITION)
    feed(writer, recording)
    fields, raw = writer.path, writer.path.with_name("c.part.raw")
    fields.write_bytes(fields.read_bytes()[: fields.stat().st_size - 4 * cut])
    raw.write_bytes(raw.read_bytes()[: max(raw.stat().st_size - 2 * cut, 0)])
    if cut > 320:  # less than one line of 64 samples is left
        with pytest.raises(InputError, match="no whole frame"):
            recover(tmp_path / "c.igs.mha")
        return
    count = recover(tmp_path / "c.igs.mha")
    read = read_recording(tmp_path / "c.igs.mha")
    assert len(read) == count
    np.testing.assert_array_equal(read.lines, recording.lines[:count])
    np.testing.assert_array_equal(read.probe_to_reference, recording.probe_to_reference[:count])


def test_an_interrupted_recording_is_not_overwritten(tmp_path):
    writer = RecordingWriter(tmp_path / "a.igs.mha", 4, ACQUISITION)
    writer.append(0.0, {"ProbeToReference": np.eye(4)}, line=np.zeros(4, dtype=np.int16))
    with pytest.raises(InputError, match="interrupted recording; recover or remove it"):
        RecordingWriter(tmp_path / "a.igs.mha")


def test_room_is_made_for_a_recording_and_an_interrupted_one_is_joined_before_it_is_put_aside(tmp_path):
    path = tmp_path / "a.igs.mha"
    assert put_aside(path) is None
    for number in (1, 2):
        writer = RecordingWriter(path, 4, ACQUISITION)
        writer.append(0.0, {"ProbeToReference": np.eye(4)}, line=np.full(4, number, dtype=np.int16))
        aside = put_aside(path)  # its process was killed: never closed
        assert aside == tmp_path / f"a-{number}.igs.mha"
        assert read_recording(aside).lines.tolist() == [[number] * 4]
    (tmp_path / "a.part.raw").write_bytes(b"pixels without a header")
    assert put_aside(path) is None
    RecordingWriter(path, 4, ACQUISITION).close()
    assert (tmp_path / "a-1.part.raw").is_file(), "kept"


def test_what_is_no_recording_is_not_put_aside_for_one(tmp_path):
    (tmp_path / "photo.jpg").write_text("dear")
    with pytest.raises(InputError, match="give a name with that ending"):
        put_aside(tmp_path / "photo.jpg")
    assert (tmp_path / "photo.jpg").is_file()


def test_an_older_recording_is_safe_until_the_first_frame_of_the_new_one(tmp_path):
    recording, path = a_recording(), tmp_path / "a.igs.mha"
    write_recording(path, recording)
    RecordingWriter(path, 64, ACQUISITION).close()
    assert_same(read_recording(path), recording)
    assert [found.name for found in tmp_path.iterdir()] == ["a.igs.mha"]
    with RecordingWriter(path, 64, ACQUISITION) as writer:
        writer.append(0.0, {"ProbeToReference": np.eye(4)}, line=recording.lines[0])
    assert len(read_recording(path)) == 1


@pytest.mark.skipif(not hasattr(os, "pwrite"), reason="fills the disk by a stand-in for pwrite")
def test_a_full_disk_is_told_and_what_was_written_is_safe(tmp_path, monkeypatch):
    recording = a_recording(6)
    writer = RecordingWriter(tmp_path / "a.igs.mha", 64, ACQUISITION, recording.fields)
    feed(writer, recording)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", full)
        with pytest.raises(InputError, match="No space left on device; 6 frames are safe"):
            writer.append(99.0, {"ProbeToReference": np.eye(4)}, line=recording.lines[0])
    writer.close()
    assert_same(read_recording(tmp_path / "a.igs.mha"), recording)


def test_nothing_to_recover_is_told(tmp_path):
    with pytest.raises(InputError, match="nothing to recover"):
        recover(tmp_path / "a.igs.mha")


def test_a_recording_without_frames_leaves_no_file(tmp_path):
    RecordingWriter(tmp_path / "a.igs.mha").close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"timestamp_s": 0.5}, "the one before at 1.0 s"),
        ({"timestamp_s": float("nan")}, "frame 1 is at nan s"),
        ({"line": np.zeros(5, dtype=np.int16)}, "5 samples, expected 4"),
        ({"line": None}, "0 samples, expected 4"),
        ({"transforms": {"Probe": np.eye(4)}}, "'Probe' is not of the form"),
        ({"transforms": {"AToBToC": np.eye(4)}}, "'AToBToC' is not of the form"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused_and_leaves_the_recording_whole(tmp_path, arguments, message):
    writer = RecordingWriter(tmp_path / "a.igs.mha", 4, ACQUISITION)
    good = {"timestamp_s": 1.0, "transforms": {"ProbeToReference": np.eye(4)}, "line": np.zeros(4, dtype=np.int16)}
    writer.append(**good)
    with pytest.raises(InputError, match=message):
        writer.append(**{**good, **arguments})
    writer.close()
    assert len(read_recording(tmp_path / "a.igs.mha")) == 1
    with pytest.raises(InputError, match="closed"):
        writer.append(**good)


@pytest.mark.parametrize("fields", [{"two words": "x"}, {"A": "x\ny"}, {"A": "Grüße"}, {"A": "x" * 1000}])
def test_fields_that_other_readers_choke_on_are_refused(tmp_path, fields):
    with pytest.raises(InputError, match="cannot be stored"):
        RecordingWriter(tmp_path / "a.igs.mha", fields=fields)


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(InputError, match="that ending"):
        write_recording(tmp_path / "a.nrrd", a_recording())


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="choose a folder"):
        RecordingWriter(tmp_path / "none" / "a.igs.mha")


@pytest.mark.slow
def test_an_hour_at_60_hz_keeps_memory_flat(tmp_path):
    code = (
        "import sys, resource, numpy as np\n"
        "from CranioNavLib.sequence_metafile import RecordingWriter, Acquisition\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "line = np.arange(3200, dtype=np.int16)\n"
        "with RecordingWriter(sys.argv[1], 3200, Acquisition(50e6, 5e6)) as writer:\n"
        "    for k in range(216000):\n"
        "        writer.append(k / 60, {'ProbeToReference': np.eye(4)}, line=line)\n"
        "        if k == 1000: early = peak()\n"
        "print(early, peak())\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "h.igs.mha")], capture_output=True, text=True, check=True)
    early, late = (int(kilobytes) for kilobytes in done.stdout.split())
    assert late - early < 8000  # kB, the closing included
    assert (tmp_path / "h.igs.mha").stat().st_size > 216000 * 6400
