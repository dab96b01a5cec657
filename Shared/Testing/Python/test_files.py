"""A file is whole or not there."""

from __future__ import annotations

import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.files import output_folder, write_text, written_whole


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path):
    target = tmp_path / "result.igs.mha"
    target.write_text("old")
    with pytest.raises(RuntimeError), written_whole(target) as temporary:
        temporary.write_text("half")
        assert temporary.name.endswith(".igs.mha")
        raise RuntimeError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_finished_write_replaces(tmp_path):
    write_text(tmp_path / "a.json", "{}")
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert (tmp_path / "a.json").stat().st_mode & 0o044


def test_a_missing_folder_is_refused_in_words(tmp_path):
    with pytest.raises(InputError, match="cannot write .*No such file or directory; choose a folder"):
        write_text(tmp_path / "absent" / "a.json", "{}")


def test_a_folder_in_the_place_of_the_file_is_refused_and_left_alone(tmp_path):
    for path in (tmp_path, ""):
        with pytest.raises(InputError, match="is a folder; give the name of a file"), written_whole(path):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="cannot write into"):
        output_folder(tmp_path / "out")
