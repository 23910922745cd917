"""Pictures that nobody vouches for: what is refused and at what cost, and what tells a camera from a picture of one."""

import itertools
import os
import re
from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.car.picture import block_sums, brightness, check_jpeg, decode_jpeg, read_jpeg
from rover_lib.onboard.errors import CameraError
from tests.helpers import hostile
from tests.helpers.hostile import HOSTILE, WHOLE, jpeg, scene


def test_what_is_not_all_of_a_cameras_picture_is_refused_cheaply(tmp_path):
    for name, data in HOSTILE.items():
        (tmp_path / "picture.jpg").write_bytes(data)
        said = hostile.outcome_of(read_jpeg, tmp_path / "picture.jpg", most_s=5, most_bytes=300_000_000)
        assert said.startswith("said "), f"{name}: {said}"


def test_what_a_camera_may_send_is_decoded_as_opencv_does():
    for data in (WHOLE, hostile.RESTARTS, jpeg(scene()[:, :, 0]), jpeg(scene(), 30), hostile.progressive(scene())):
        assert (decode_jpeg(data) == cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)).all()
        assert decode_jpeg(data, 96).shape == (90, 160, 3)  # a quarter: an eighth would have 80
    begin = WHOLE.index(b"\xff\xc4")
    without_tables = WHOLE[:begin] + WHOLE[hostile.SCAN - 14 :]  # as webcams send them
    assert (decode_jpeg(without_tables) == decode_jpeg(WHOLE)).all()


FILLED = re.compile(rb"(?=\xff[\xd0-\xd7])").sub(b"UU", hostile.RESTARTS, 3)  # as a Logitech C270 sends nearly each one


def test_filler_before_markers_is_no_damage():
    assert FILLED != hostile.RESTARTS
    in_header = WHOLE.replace(b"\xff\xc0", b"UU\xff\xc0", 1)
    assert not is_taken(hostile.cut(in_header)) and not is_taken(in_header[:12000] + bytes(4000) + in_header[16000:])
    for filled in (FILLED, hostile.RESTARTS[:-2] + b"UUUU\xff\xd9", WHOLE[:-2] + b"UU\xff\xd9", in_header):
        assert (decode_jpeg(filled) == decode_jpeg(hostile.RESTARTS if filled.count(b"\xff\xd0") else WHOLE)).all()


@given(st.integers(100, 26_000), st.integers(1, 3000))
def test_what_is_torn_after_filler_is_torn(from_end, missing):
    """libjpeg's first warning is about the filler, and simplejpeg has no other: half a picture was missing."""
    whole, filled = (
        data[: len(data) - from_end] + data[min(len(data) - from_end + missing, len(data) - 2) :]
        for data in (hostile.RESTARTS, FILLED)
    )
    assert is_taken(filled) == is_taken(whole)


def test_a_picture_that_its_exif_data_turn_is_refused():
    """Other programs show it turned; nobody can say what a policy was trained on."""
    for orientation, taken in ((1, True), (3, False), (6, False)):
        tag = b"\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0])
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + tag + bytes(4)
        assert is_taken(WHOLE[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + WHOLE[2:]) is taken


def is_taken(data):
    with suppress(CameraError):
        return decode_jpeg(data).shape[:2] == check_jpeg(data)
    with pytest.raises(CameraError):
        check_jpeg(data)
    return False


def test_a_file_that_is_none(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(CameraError, match="no plain file"):
        read_jpeg(tmp_path / "fifo")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(CameraError, match=r"too large, found 8\.0 MB"):
        read_jpeg(tmp_path / "large")


def noisy(image, sigma, rng) -> np.ndarray:
    return np.clip(np.rint(image + rng.normal(0, sigma, image.shape)), 0, 255).astype(np.uint8)


def test_a_sensors_noise_tells_two_pictures_of_the_same_apart():
    """Down to a quarter of a grey level, through a JPEG of a bad webcam: a car that stands before a still scene."""
    rng = np.random.default_rng(0)
    pictures = [block_sums(decode_jpeg(jpeg(noisy(scene(), 0.25, rng), 30))) for _ in range(6)]
    assert all((a == b).mean() < 0.6 for a, b in itertools.combinations(pictures, 2))


def test_contrast_is_of_the_scene_and_not_of_the_noise():
    rng = np.random.default_rng(0)
    grey = np.full((360, 640, 3), 128, np.uint8)
    for nothing in (grey, noisy(grey, 8, rng), np.full_like(grey, 255)):
        assert brightness(nothing)[1] < 2
    assert brightness(scene())[1] > 20 and brightness(grey)[0] == 128
    coloured = grey.copy()
    coloured[:, :320, 0] = 160
    assert brightness(coloured)[1] == pytest.approx(16, abs=0.1)
