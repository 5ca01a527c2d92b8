"""The projection room: an animation of the filter for a page, drawn by the browser from a few hundred
kilobytes.

A film of thousands of moving dots is large and blurred; the dots themselves are small and sharp. So the page
gets the coordinates and a short script that draws them, with a button, a slider, and nothing loaded from
elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from string import Template

import numpy as np

COLOURS = {
    "map": "#8C8C8C",
    "cloud": "#009E73",
    "particles": "#E69F00",
    "estimate": "#D55E00",
    "truth": "#000000",
}
CLOUD_STEP, PARTICLE_STEP, MAP_STEP = 0.35, 0.03, 0.1  # resolution of what is drawn [m]


@dataclass(frozen=True)
class Frame:
    """What one picture shows, all in the map frame.

    Attributes
    ----------
    cloud : array, shape (n, 2)
        The scan's points, laid on the map at the estimate [m].
    particles : array, shape (k, 2) or (k, 3)
        Particles [m].
    estimate, truth : array, shape (3,)
        Poses [m, m, rad].
    text : str
        Words beside the slider.
    """

    cloud: np.ndarray
    particles: np.ndarray
    estimate: np.ndarray
    truth: np.ndarray
    text: str


def play_filter(
    map_points: np.ndarray,
    frames: Sequence[Frame],
    words: str,
    *,
    half: float = 40.0,
    size: int = 520,
    frames_per_second: float = 8.0,
    max_points: int = 400,
    max_particles: int = 120,
    cloud_colour: str = COLOURS["cloud"],
) -> str:
    """Build an animation of the filter as a piece of HTML, the estimate in the middle, x up and y to the
    left.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        The map [m].
    frames : sequence of Frame
        The pictures, at least one.
    words : str
        What is to be seen, for those who cannot see it.
    half : float
        Half the edge of the part of the map that is shown, at most 44 [m].
    size : int
        Edge of the picture [pixels].
    frames_per_second : float
        Speed.
    max_points, max_particles : int
        Of larger clouds and sets only so many are kept, evenly chosen.
    cloud_colour : str
        Colour of the scan's points, "#RRGGBB".

    Returns
    -------
    html : str
        For `IPython.display.HTML`.

    Raises
    ------
    ValueError
        If there is no frame or a value is not finite.
    """
    if not frames:
        raise ValueError("no frame to play")
    reach = max(np.abs(frame.truth[:2] - frames[0].truth[:2]).max() for frame in frames) + half
    origin = frames[0].truth[:2]
    near = map_points[np.abs(map_points - origin).max(axis=1) < reach]
    clouds = [_pack(_thin(f.cloud, max_points) - f.estimate[:2], CLOUD_STEP, np.int8) for f in frames]
    swarms = [
        _pack(_thin(f.particles[:, :2], max_particles) - f.estimate[:2], PARTICLE_STEP, np.int8)
        for f in frames
    ]
    data = {
        "half": half,
        "steps": [MAP_STEP, CLOUD_STEP, PARTICLE_STEP],
        "pause": 1000.0 / frames_per_second,
        "colours": {**COLOURS, "cloud": cloud_colour},
        "origin": np.round(origin, 3).tolist(),
        "map": _pack(_thin_cells(near - origin, 0.4), MAP_STEP, np.int16),
        "frames": [
            [cloud, swarm, np.round(f.estimate, 3).tolist(), np.round(f.truth, 3).tolist(), f.text]
            for cloud, swarm, f in zip(clouds, swarms, frames, strict=True)
        ],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    name = "player-" + hashlib.sha256(text.encode()).hexdigest()[:10]
    return _PAGE.substitute(name=name, words=html.escape(words), size=size, last=len(frames) - 1, data=text)


def _thin(points: np.ndarray, most: int) -> np.ndarray:
    """Keep at most so many points, evenly chosen."""
    points = np.asarray(points, dtype=np.float64)
    return points if len(points) <= most else points[np.linspace(0, len(points) - 1, most).astype(int)]


def _thin_cells(points: np.ndarray, cell: float) -> np.ndarray:
    """Keep the first point of each cell."""
    _, first = np.unique(np.floor(points / cell), axis=0, return_index=True)
    return points[np.sort(first)]


def _pack(points: np.ndarray, step: float, kind: type) -> str:
    """Round to steps, drop what the kind of integer cannot hold, and write as base64."""
    if not np.isfinite(points).all():
        raise ValueError("a point to be drawn is not finite")
    steps = np.round(points / step)
    steps = steps[(np.abs(steps) <= np.iinfo(kind).max).all(axis=1)]
    return base64.b64encode(steps.astype(kind).tobytes()).decode()


_PAGE = Template("""<div id="$name" style="max-width: ${size}px">
<canvas width="$size" height="$size" role="img" aria-label="$words" style="width: 100%"></canvas>
<div style="display: flex; gap: 0.6em; align-items: center">
<button type="button" aria-label="play or pause" style="width: 3em">&#9654;</button>
<input type="range" min="0" max="$last" value="0" aria-label="time" style="flex: 1">
<span style="font-variant-numeric: tabular-nums; white-space: nowrap"></span>
</div>
<script>
(() => {
const data = $data;
const box = document.getElementById("$name");
const canvas = box.querySelector("canvas"), pen = canvas.getContext("2d");
const button = box.querySelector("button"), slider = box.querySelector("input");
const note = box.querySelector("span");
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const land = new Int16Array(bytes(data.map).buffer), scale = canvas.width / (2 * data.half);
const mid = canvas.width / 2;
const dots = (values, step, shift, colour, edge) => {
  pen.fillStyle = colour;
  for (let k = 0; k < values.length; k += 2) {
    const u = mid - (values[k + 1] * step + shift[1]) * scale;
    const v = mid - (values[k] * step + shift[0]) * scale;
    pen.fillRect(u - edge / 2, v - edge / 2, edge, edge);
  }
};
const arrow = (pose, eye, colour) => {
  pen.save();
  pen.translate(mid - (pose[1] - eye[1]) * scale, mid - (pose[0] - eye[0]) * scale);
  pen.rotate(-pose[2]);
  pen.strokeStyle = colour; pen.lineWidth = 3; pen.lineCap = "round"; pen.beginPath();
  for (const [x, y] of [[0, 0], [0, -30], [-7, -21], [0, -30], [7, -21]]) pen.lineTo(x, y);
  pen.stroke(); pen.restore();
};
const draw = () => {
  const [cloud, swarm, eye, truth, text] = data.frames[slider.value], c = data.colours;
  pen.fillStyle = "#FFFFFF"; pen.fillRect(0, 0, canvas.width, canvas.height);
  dots(land, data.steps[0], [data.origin[0] - eye[0], data.origin[1] - eye[1]], c.map, 2);
  dots(new Int8Array(bytes(cloud).buffer), data.steps[1], [0, 0], c.cloud, 3);
  dots(new Int8Array(bytes(swarm).buffer), data.steps[2], [0, 0], c.particles, 3);
  arrow(truth, eye, c.truth); arrow(eye, eye, c.estimate);
  note.textContent = text;
};
let timer = null;
const stop = () => { clearInterval(timer); timer = null; button.innerHTML = "&#9654;"; };
const step = () => { slider.value = +slider.value < +slider.max ? +slider.value + 1 : 0; draw(); };
button.onclick = () => {
  if (timer) { stop(); return; }
  timer = setInterval(step, data.pause); button.innerHTML = "&#10074;&#10074;";
};
slider.oninput = () => { stop(); draw(); };
draw();
})();
</script>
</div>""")
