"""Images: what is read as it is, and what is refused before it costs memory."""

import struct
import subprocess
import sys
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jaxslam.vision.images import Images, _parse_header, check_size, read_image

RNG = np.random.default_rng(0)
PICTURE = cv2.GaussianBlur(RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8), (0, 0), 3)
FORMATS = ("png", "jpg", "ppm", "bmp", "tiff")


def encoded(suffix, image=PICTURE):
    return cv2.imencode(f".{suffix}", image)[1].tobytes()


def written(folder, name, data):
    path = folder / name
    path.write_bytes(data)
    return path


def png(width, height, bits=8):
    """A PNG that says it is so large, with next to no data."""

    def chunk(name, body):
        return (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_is_read_and_its_header_agrees(tmp_path, suffix):
    path = written(tmp_path, f"a.{suffix}", encoded(suffix))
    image = read_image(path)
    assert image.dtype == np.uint8
    assert image.shape == PICTURE.shape
    error = np.abs(image.astype(int) - PICTURE).max()
    assert error < 12 if suffix == "jpg" else error == 0
    assert _parse_header(path, path.read_bytes())[1] == (64, 48, 8)


@pytest.mark.parametrize("suffix", ("png", "jpg", "pgm", "bmp", "tiff"))
def test_grey_comes_as_three_equal_channels(tmp_path, suffix):
    image = read_image(written(tmp_path, f"a.{suffix}", encoded(suffix, PICTURE[:, :, 0])))
    assert image.shape == PICTURE.shape
    assert (image == image[:, :, :1]).all()


def test_channels_are_blue_green_red(tmp_path):
    ppm = b"P6 # a comment\n2 1\n255\n" + bytes([255, 0, 0, 0, 0, 9])
    assert read_image(written(tmp_path, "a.ppm", ppm)).tolist() == [[[0, 0, 255], [9, 0, 0]]]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("kept", (0.02, 0.5, 0.95))
def test_truncated_files_are_refused(tmp_path, suffix, kept):
    data = encoded(suffix)
    path = written(tmp_path, f"a.{suffix}", data[: int(len(data) * kept)])
    with pytest.raises(ValueError, match=r"a\.\w+: .*(truncated|decoded)"):
        read_image(path)


def test_a_thumbnails_end_is_not_taken_for_the_images_end(tmp_path):
    data = encoded("jpg")
    thumbnail = b"\xff\xe1" + struct.pack(">H", 8) + b"ab\xff\xd9cd"
    whole = data[:2] + thumbnail + data[2:]
    assert read_image(written(tmp_path, "a.jpg", whole)).shape == PICTURE.shape
    with pytest.raises(ValueError, match="truncated"):
        read_image(written(tmp_path, "b.jpg", whole[:-40]))


@pytest.mark.parametrize("suffix", ("png", "tiff", "ppm"))
def test_sixteen_bits_are_refused_with_the_remedy(tmp_path, suffix):
    path = written(tmp_path, f"a.{suffix}", encoded(suffix, PICTURE.astype(np.uint16) * 257))
    with pytest.raises(ValueError, match=r"a\.\w+: 16 bits per channel.*convert it first"):
        read_image(path)


def test_a_huge_image_is_refused_by_its_header(tmp_path):
    path = written(tmp_path, "a.png", png(30_000, 30_000))
    with pytest.raises(ValueError, match=r"a\.png: 30000 x 30000 pixels; 1 to 100 million"):
        read_image(path)


@pytest.mark.parametrize(
    "data", (b"", b"\x89PNG", b"P5 x", b"II*\0", b"\xff\xd8\xff\xe0", b"hello")
)
def test_what_is_no_image_is_one_clear_line(tmp_path, data):
    with pytest.raises(ValueError, match=r"a\.bin: ") as error:
        read_image(written(tmp_path, "a.bin", data))
    assert "\n" not in str(error.value)


def test_an_image_smaller_than_its_header_says_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a\.png: "):
        read_image(written(tmp_path, "a.png", png(64, 48)))


def test_folders_and_missing_files_are_no_images(tmp_path):
    for path, told in ((tmp_path, "is a folder"), (tmp_path / "absent.png", "no such file")):
        with pytest.raises(ValueError, match=told):
            read_image(path)


def test_a_folder_comes_in_natural_order_and_goes_on_after_a_bad_file(tmp_path):
    for i in (10, 9, 1):
        written(tmp_path, f"i{i}.png", encoded("png", np.full((4, 4, 3), i, np.uint8)))
    written(tmp_path, "i2.png", b"no picture")
    written(tmp_path, "notes.txt", b"not an image")
    written(tmp_path, ".i3.png", b"hidden")
    images = Images(tmp_path)
    assert len(images) == 4
    names, values = zip(*images, strict=True)
    assert names == ("i1.png", "i2.png", "i9.png", "i10.png")
    assert isinstance(values[1], ValueError)
    assert [v[0, 0, 0] for i, v in enumerate(values) if i != 1] == [1, 9, 10]
    assert [name for name, _ in images.stream(first=2)] == ["i9.png", "i10.png"]


def test_lists_patterns_and_single_files(tmp_path):
    a, b = (written(tmp_path, name, encoded("png")) for name in ("a.png", "b.png"))
    assert [name for name, _ in Images([b, a])] == ["b.png", "a.png"]
    assert [name for name, _ in Images(tmp_path / "*.png")] == ["a.png", "b.png"]
    assert [name for name, _ in Images(str(a))] == ["a.png"]
    ((name, error),) = Images([tmp_path / "absent.png"])
    assert name == "absent.png" and "no such file" in str(error)


def test_nothing_to_read_is_said(tmp_path):
    for source in (tmp_path, tmp_path / "*.png", []):
        with pytest.raises(ValueError, match="no images"):
            Images(source)
    with pytest.raises(ValueError, match="no such file or folder"):
        Images(tmp_path / "absent")


def test_a_video_is_read_frame_by_frame(tmp_path):
    path = str(tmp_path / "v.avi")
    video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (64, 48))
    if not video.isOpened():
        pytest.skip("this OpenCV can't write videos")
    for i in range(5):
        video.write(np.full((48, 64, 3), 40 * i, np.uint8))
    video.release()
    images = Images(path)
    assert len(images) == 5
    names, frames = zip(*images.stream(first=2), strict=True)
    assert names == ("v.avi#000002", "v.avi#000003", "v.avi#000004")
    assert [round(float(frame.mean()) / 40) for frame in frames] == [2, 3, 4]
    with pytest.raises(ValueError, match="can't be opened as a video"):
        Images(written(tmp_path, "broken.mp4", b"nothing"))


def test_another_size_than_the_cameras_is_told():
    camera = SimpleNamespace(width=640, height=480)
    check_size(np.zeros((480, 640, 3), np.uint8), camera, "a.png")
    with pytest.raises(ValueError, match=r"a\.png: 64 x 48 pixels; .*640 x 480"):
        check_size(PICTURE, camera, "a.png")


def test_the_decoders_own_limit_is_set_unless_the_user_has_one():
    code = "import os, sys; {}; import jaxslam.vision.images; print(os.environ['{}'])"
    name = "OPENCV_IO_MAX_IMAGE_PIXELS"
    for first, expected in (("pass", "100000000"), (f"os.environ['{name}'] = '5'", "5")):
        run = [sys.executable, "-c", code.format(first, name)]
        assert subprocess.run(run, capture_output=True, text=True).stdout.strip() == expected


def test_recorded_images_are_read(shared_data):
    for folder, count, size in (
        ("calib_ocam_vmr", 11, (1024, 768)),
        ("calib_inria_para", 10, (1280, 1024)),
        ("calib_fisheye2", 16, (748, 480)),
    ):
        images = list(Images(shared_data / folder))
        assert len(images) == count
        assert all(image.shape == (size[1], size[0], 3) for _, image in images)
