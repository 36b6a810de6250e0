"""The log's file when it is broken or hostile."""

import io
import pickle
import zipfile

import numpy as np
import pytest
from test_log import assert_same, make

from jaxslam.logs import log_file
from jaxslam.logs.log_file import load_log, save_log


def refused(path, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_log(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def rewrite(path, changes):
    """A copy of a good log's file with entries replaced, added, or removed (None)."""
    save_log(path, make())
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (entries | changes).items():
            if data is not None:
                archive.writestr(name, data)


def npy(array):
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array))
    return file.getvalue()


def header(shape, descr="<f8"):
    file = io.BytesIO()
    fields = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, fields)
    return file.getvalue()


class Trap:
    """Unpickled, it would make a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickles_are_never_opened(tmp_path):
    path, sprung = tmp_path / "a.npz", tmp_path / "sprung"
    objects = np.array([Trap(sprung)], object)
    rewrite(path, {"bearing.npy": npy(objects)})
    refused(path, "'bearing' holds object")
    rewrite(path, {"bearing.npy": pickle.dumps(Trap(sprung))})
    refused(path, "magic")
    assert not sprung.exists()


HOSTILE = {
    "absurd shape": ({"bearing.npy": header((2**62, 4)) + bytes(24)}, "can't be"),
    "shape beyond data": ({"bearing.npy": header((4,)) + bytes(24)}, "can't be"),
    "negative shape": ({"bearing.npy": header((-1, -3)) + bytes(24)}, "dimensions"),
    "empty and huge": ({"bearing.npy": header((0, 2**62))}, "damaged"),
    "five dimensions": ({"bearing.npy": npy(np.zeros((1, 1, 1, 1, 3)))}, "dimensions"),
    "structure": ({"bearing.npy": npy(np.zeros(3, "f8,f8"))}, "only numbers and text"),
    "complex": ({"bearing.npy": npy(np.zeros(3, complex))}, "only numbers and text"),
    "long text": ({"name.npy": npy("x" * 20000)}, "can't be"),
    "trailing": ({"bearing.npy": npy(np.zeros(3)) + b"more"}, "can't be"),
    "no array": ({"readme.txt": b"hello"}, "'readme.txt' is no array"),
    "unknown": ({"colour.npy": npy([1.0])}, "unknown entry 'colour'"),
    "unknown truth": ({"truth/colour.npy": npy([1.0])}, "unknown entry 'truth/colour'"),
    "truth whole": ({"truth.npy": npy([1.0])}, "unknown entry 'truth'"),
    "unknown part": ({"map/x.npy": npy([1.0])}, "unknown entry 'map/x'"),
    "no schema": ({"schema.npy": None}, "schema None"),
    "later schema": ({"schema.npy": npy(2)}, "schema 2; this version reads 1"),
    "no frames": ({"frame_time.npy": None}, "no entry 'frame_time'"),
    "name is a number": ({"name.npy": npy(3)}, "name: 3"),
    "NaN": ({"bearing.npy": npy([0.0, np.nan, 0.0])}, "bearing, row 1"),
    "scalar": ({"bearing.npy": npy(0.5)}, r"bearing: shape \(\)"),
    "bad header": ({"bearing.npy": b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16}, "damaged"),
}


@pytest.mark.parametrize(("changes", "message"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_file_is_refused(changes, message, tmp_path):
    rewrite(tmp_path / "a.npz", changes)
    refused(tmp_path / "a.npz", message)


def test_sizes_are_checked_before_anything_is_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    rewrite(path, {"bearing.npy": header((2**21,)) + bytes(2**24)})
    assert path.stat().st_size < 2**16
    monkeypatch.setattr(log_file, "MAX_BYTES", 2**20)
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *_, **__: pytest.fail("was unpacked"))
    refused(path, "allowed are")


def test_too_many_entries(tmp_path):
    extra = {f"skipped/{i}.npy": npy(i) for i in range(log_file.MAX_ENTRIES)}
    rewrite(tmp_path / "a.npz", extra)
    refused(tmp_path / "a.npz", "entries")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_entry_twice(tmp_path):
    path = tmp_path / "a.npz"
    save_log(path, make())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("bearing.npy", npy(np.zeros(3)))
    refused(path, "there twice")


def test_cuts_and_flipped_bits_never_give_other_data(tmp_path):
    good = tmp_path / "good.npz"
    save_log(good, make())
    data, path = good.read_bytes(), tmp_path / "bad.npz"
    for length in range(0, len(data), 97):
        path.write_bytes(data[:length])
        refused(path, "damaged")
    caught = 0
    for place in range(0, len(data), 3):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        try:
            assert_same(load_log(path), make())  # dates and the like may differ
        except ValueError:
            caught += 1
    assert caught > len(data) / 3 / 2


def test_what_is_no_log(tmp_path):
    refused(tmp_path / "absent.npz", "no such file")
    refused(tmp_path, "jaxslam convert")
    text = tmp_path / "a.npz"
    text.write_text("time_s,bearing_rad\n1,2\n")
    refused(text, "not a log")
    text.write_bytes(b"")
    refused(text, "not a log")
    text.write_bytes(npy(np.zeros(3)))
    refused(text, "not a log")
