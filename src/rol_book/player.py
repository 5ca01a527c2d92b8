"""Animations for a page, drawn by the browser, with a button and a slider.

A film of thousands of moving dots is large and blurred. So the page holds their coordinates and a short
script that draws them; of images it holds small compressed ones. Nothing is loaded from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import Template

import cv2
import numpy as np

from rol.geometry import first_of_cells

COLOURS = {
    "map": "#8C8C8C",
    "cloud": "#009E73",
    "particles": "#E69F00",
    "estimate": "#D55E00",
    "truth": "#000000",
}
CLOUD_STEP, PARTICLE_STEP, MAP_STEP = 0.35, 0.03, 0.1  # resolution of the coordinates [m]
FILTER_SIZE = 520  # edge of the animation of the filter [pixels]
MAX_POINTS, MAX_PARTICLES = 400, 120  # larger sets are thinned evenly
FILTER_FPS, IMAGES_FPS = 8.0, 4.0


@dataclass(frozen=True)
class Frame:
    """One frame of an animation, all in the map frame.

    Attributes
    ----------
    cloud : array, shape (n, 2)
        The scan's points, laid on the map at the estimate [m].
    particles : array, shape (k, 2) or (k, 3)
        Particles [m].
    estimate, truth : array, shape (3,)
        Poses [m, m, rad].
    text : str
        Text beside the slider.
    """

    cloud: np.ndarray
    particles: np.ndarray
    estimate: np.ndarray
    truth: np.ndarray
    text: str


def play_filter(
    map_points: np.ndarray,
    frames: Sequence[Frame],
    description: str,
    *,
    half: float = 40.0,
    cloud_colour: str = COLOURS["cloud"],
) -> str:
    """Build an animation of the filter as HTML, the estimate in the middle, x up, y left.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        The map [m].
    frames : sequence of Frame
        The pictures, at least one.
    description : str
        Description of the animation for screen readers.
    half : float
        Half the edge of the part of the map that is shown, at most 44 [m].
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
    clouds = [_pack(_thin(f.cloud, MAX_POINTS) - f.estimate[:2], CLOUD_STEP, np.int8) for f in frames]
    swarms = [
        _pack(_thin(f.particles[:, :2], MAX_PARTICLES) - f.estimate[:2], PARTICLE_STEP, np.int8)
        for f in frames
    ]
    data = {
        "half": half,
        "steps": [MAP_STEP, CLOUD_STEP, PARTICLE_STEP],
        "pause": 1000.0 / FILTER_FPS,
        "colours": {**COLOURS, "cloud": cloud_colour},
        "origin": np.round(origin, 3).tolist(),
        "map": _pack(first_of_cells(near - origin, 0.4), MAP_STEP, np.int16),
        "frames": [
            [cloud, swarm, np.round(f.estimate, 3).tolist(), np.round(f.truth, 3).tolist(), f.text]
            for cloud, swarm, f in zip(clouds, swarms, frames, strict=True)
        ],
    }
    return _page(data, description, FILTER_SIZE, FILTER_SIZE, _DRAW_FILTER)


def play_images(
    panels: Mapping[str, Sequence[np.ndarray]],
    texts: Sequence[str],
    description: str,
    *,
    colours: Mapping[str, str],
    metres_across: float,
    size: int = 320,
    quality: int = 40,
) -> str:
    """Build an animation of images side by side as HTML, the car in the middle of each, driving up.

    Parameters
    ----------
    panels : mapping of str to sequence of array, shape (h, h), uint8
        The images of each panel in the order of time, by its title.
    texts : sequence of str
        Text beside the slider, for each time.
    description : str
        Description of the animation for screen readers.
    colours : mapping of str to str
        Panels that are drawn in one colour, "#RRGGBB", wherever they are not 0; the others are grey, dark on
        white.
    metres_across : float
        Edge of what an image shows [m].
    size : int
        Edge of a panel [pixels]; images are stored no larger.
    quality : int
        Of the grey images, 1 to 100; they are kept as JPEG, the others without loss.

    Returns
    -------
    html : str
        For `IPython.display.HTML`.

    Raises
    ------
    ValueError
        If there is no image, a panel has another number of them than there are texts, or an image is not of
        grey values.
    """
    if not texts or not panels:
        raise ValueError("no image to play")
    for title, images in panels.items():
        if len(images) != len(texts):
            raise ValueError(f"{title}: {len(images)} images, but {len(texts)} texts")
    rows = [
        [_encode(image, colours.get(title), size, quality) for image in images]
        for title, images in panels.items()
    ]
    data = {
        "pause": 1000.0 / IMAGES_FPS,
        "size": size,
        "across": metres_across,
        "titles": list(panels),
        "frames": [[*images, text] for *images, text in zip(*rows, texts, strict=True)],
    }
    gap, head = 12, 34
    width = len(panels) * (size + gap) - gap
    return _page({**data, "gap": gap, "head": head}, description, width, size + head, _DRAW_IMAGES)


def _encode(image: np.ndarray, colour: str | None, size: int, quality: int) -> str:
    """Encode an image as a data URL: JPEG of its greys, dark on white, or PNG in one colour."""
    image = np.asarray(image)
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(
            f"an image of grey values must have shape (h, w) and type uint8, not {image.shape}, {image.dtype}"
        )
    scale = min(size / max(image.shape), 1.0)
    if colour is None:
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        kind, coded = "jpeg", cv2.imencode(".jpg", 255 - small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    else:
        full = (image > 0).astype(np.float32)
        full = cv2.resize(full, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) > 0.0
        blue_green_red = [int(colour[k : k + 2], 16) for k in (5, 3, 1)]
        painted = np.where(full[..., None], blue_green_red, 255).astype(np.uint8)
        kind, coded = "png", cv2.imencode(".png", painted, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    return f"data:image/{kind};base64,{base64.b64encode(coded.tobytes()).decode()}"


def _page(data: dict, description: str, width: int, height: int, draw: str) -> str:
    """Return the HTML of an animation: data, drawing script, button and slider."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return _PAGE.substitute(
        name="player-" + hashlib.sha256(text.encode()).hexdigest()[:10],
        description=html.escape(description),
        width=width,
        height=height,
        last=len(data["frames"]) - 1,
        data=text,
        draw=draw,
    )


def _thin(points: np.ndarray, most: int) -> np.ndarray:
    """Keep at most `most` points, evenly chosen."""
    points = np.asarray(points, dtype=np.float64)
    return points if len(points) <= most else points[np.linspace(0, len(points) - 1, most).astype(int)]


def _pack(points: np.ndarray, step: float, kind: type) -> str:
    """Quantize coordinates, discard those beyond the integer type, and encode them as base64."""
    if not np.isfinite(points).all():
        raise ValueError("a point of the animation is not finite")
    steps = np.round(points / step)
    steps = steps[(np.abs(steps) <= np.iinfo(kind).max).all(axis=1)]
    return base64.b64encode(steps.astype(kind).tobytes()).decode()


_PAGE = Template("""<div id="$name" style="max-width: ${width}px">
<canvas width="$width" height="$height" role="img" aria-label="$description" style="width: 100%"></canvas>
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
$draw
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

_DRAW_FILTER = """const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
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
};"""

_DRAW_IMAGES = """const load = (address) => {
  const image = new Image(); image.onload = () => draw(); image.src = address; return image;
};
const ink = "#222222", metre = data.size / data.across;
const bar = [5, 10, 20, 50].find((length) => length * metre > 50) || 100;
const frame = (k) => {
  const left = k * (data.size + data.gap), mid = left + data.size / 2;
  pen.fillStyle = ink; pen.fillText(data.titles[k], left + 2, 23);
  pen.strokeStyle = ink; pen.lineWidth = 1; pen.strokeRect(left + 0.5, data.head + 0.5, data.size - 1, data.size - 1);
  pen.lineWidth = 3; pen.lineCap = "round"; pen.beginPath();
  for (const [u, v] of [[0, 9], [0, -9], [-6, -2], [0, -9], [6, -2]]) pen.lineTo(mid + u, data.head + data.size / 2 + v);
  pen.stroke();
};
const rule = () => {
  const low = canvas.height - 12;
  pen.fillStyle = "#FFFFFF"; pen.fillRect(6, low - 24, bar * metre + 64, 30);
  pen.fillStyle = ink; pen.fillRect(12, low - 6, bar * metre, 3);
  pen.fillText(bar + " m", 18 + bar * metre, low + 1);
};
const draw = () => {
  const images = shown[slider.value];
  pen.fillStyle = "#FFFFFF"; pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.font = "22px sans-serif"; pen.imageSmoothingEnabled = false;
  images.forEach((image, k) => {
    if (image.complete) pen.drawImage(image, k * (data.size + data.gap), data.head, data.size, data.size);
    frame(k);
  });
  rule(); note.textContent = data.frames[slider.value][data.titles.length];
};
const shown = [];
data.frames.forEach((row) => shown.push(row.slice(0, -1).map(load)));"""
