"""The animation: what is packed can be unpacked, and nothing is fetched from elsewhere."""

import base64
import json
import re

import cv2
import numpy as np
import pytest

from rol_book.player import CLOUD_STEP, MAP_STEP, PARTICLE_STEP, Frame, play_filter, play_images

MAP = np.array([[0.0, 0.0], [12.3, -4.5], [500.0, 0.0]])


def frame(x: float = 0.0, text: str = "now") -> Frame:
    """A frame with the estimate at (x, 1) and two points, one of them too far to be seen."""
    pose = np.array([x, 1.0, 0.5])
    return Frame(np.array([[x + 7.0, 2.0], [x + 90.0, 0.0]]), pose[None] + 0.3, pose, pose + 0.1, text)


def unpack(page: str) -> dict:
    """Read the data back out of the page."""
    return json.loads(re.search(r"const data = (.*);\n", page).group(1))


def points_of(text: str, step: float, kind: type) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=kind).reshape(-1, 2) * step


def test_the_page_holds_what_it_shall_show():
    data = unpack(play_filter(MAP, [frame(), frame(1.0)], "words"))
    (cloud, swarm, estimate, truth, text), _ = data["frames"]
    np.testing.assert_allclose(points_of(cloud, CLOUD_STEP, np.int8), [[7.0, 1.0]], atol=CLOUD_STEP / 2)
    np.testing.assert_allclose(points_of(swarm, PARTICLE_STEP, np.int8), [[0.3, 0.3]], atol=PARTICLE_STEP / 2)
    assert estimate == [0.0, 1.0, 0.5] and truth == [0.1, 1.1, 0.6] and text == "now"
    near = points_of(data["map"], MAP_STEP, np.int16) + data["origin"]
    np.testing.assert_allclose(near, MAP[:2], atol=MAP_STEP / 2 + 1e-9)  # the far point is left out


def test_large_clouds_are_thinned():
    many = Frame(
        np.random.default_rng(0).uniform(-9, 9, (5000, 2)), np.zeros((900, 3)), np.zeros(3), np.zeros(3), ""
    )
    cloud, swarm = unpack(play_filter(MAP, [many], "words"))["frames"][0][:2]
    assert len(points_of(cloud, 1.0, np.int8)) == 400 and len(points_of(swarm, 1.0, np.int8)) == 120


def test_the_page_is_safe_and_the_same_each_time():
    page = play_filter(MAP, [frame(text="</script><b>")], 'a "quoted" <word>')
    assert page == play_filter(MAP, [frame(text="</script><b>")], 'a "quoted" <word>')
    assert page.count("</script>") == 1 and "a &quot;quoted&quot; &lt;word&gt;" in page
    assert unpack(page)["frames"][0][4] == "</script><b>"
    assert "http" not in page and "src=" not in page


def test_nothing_to_play_is_an_error():
    with pytest.raises(ValueError, match="no frame"):
        play_filter(MAP, [], "words")
    with pytest.raises(ValueError, match="not finite"):
        play_filter(MAP, [Frame(MAP * np.nan, np.zeros((1, 3)), np.zeros(3), np.zeros(3), "")], "words")


# ---- images ---------------------------------------------------------------------------------------------------

GREY = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (64, 1))
MASK = np.zeros((64, 64), np.uint8)
MASK[10:20, 30:50] = 255
PANELS = {"radar": [GREY, GREY.T], "fake": [MASK, MASK.T]}


def image_of(address: str) -> np.ndarray:
    """Decode an image that an address holds, as red, green, blue."""
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), dtype=np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def play(panels: dict = PANELS, texts: tuple = ("0 s", "1 s"), **changes: object) -> str:
    settings = {"colours": {"fake": "#009E73"}, "metres_across": 80.0, "size": 64, "quality": 95} | changes
    return play_images(panels, texts, "words", **settings)


def test_images_are_kept_grey_or_in_their_colour():
    first, second = unpack(play())["frames"]
    assert first[0].startswith("data:image/jpeg") and first[1].startswith("data:image/png")
    np.testing.assert_allclose(image_of(first[0])[..., 0], 255 - GREY, atol=6)
    np.testing.assert_allclose(image_of(second[0])[..., 0], 255 - GREY.T, atol=6)
    painted = np.where(MASK[..., None] > 0, (0x00, 0x9E, 0x73), 255)
    np.testing.assert_array_equal(image_of(first[1]), painted)
    assert first[2] == "0 s" and second[2] == "1 s"


def test_small_panels_lose_no_point():
    dots = np.zeros((64, 64), np.uint8)
    dots[::16, ::16] = 1
    (shown,) = unpack(play({"fake": [dots]}, ("now",), size=16))["frames"]
    assert image_of(shown[0]).shape == (16, 16, 3)
    assert (image_of(shown[0])[..., 0] < 255).sum() == 16


def test_page_of_images_is_safe_the_same_each_time_and_fetches_nothing():
    page = play(texts=("</script>", "1 s"))
    assert page == play(texts=("</script>", "1 s")) and page.count("</script>") == 1
    assert "http" not in page and "src=" not in page
    assert unpack(page)["titles"] == ["radar", "fake"]


@pytest.mark.parametrize(
    ("panels", "texts", "words"),
    [
        ({}, ("now",), "no image"),
        (PANELS, (), "no image"),
        (PANELS, ("now",), "radar: 2 images, but 1 texts"),
        ({"radar": [GREY.astype(float)]}, ("now",), "uint8"),
        ({"radar": [GREY[..., None]]}, ("now",), r"\(h, w\)"),
    ],
)
def test_images_that_cannot_be_played_are_refused(panels: dict, texts: tuple, words: str):
    with pytest.raises(ValueError, match=words):
        play(panels, texts)
