"""The animation: what is packed can be unpacked, and nothing is fetched from elsewhere."""

import base64
import json
import re

import numpy as np
import pytest

from rol.player import CLOUD_STEP, MAP_STEP, PARTICLE_STEP, Frame, play_filter

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
