"""Compare the points of whole sessions with the lidar points: generated points, controls and networks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rol.bev import image_to_points
from rol.oxford import load_radar, open_session
from rol.pairs import list_pairs, load_pair, read_image, read_points
from rol.pix2pix import TrainedNetwork, generate
from rol.similarity import distance_histogram, nn_distances, similarity_summary, summarize_distances
from rol_beyond.front_ends import DETECTORS, detect_points

SPEEDS = {"below 1": 1.0, "1 to 4": 4.0, "4 to 7": 7.0, "above 7": np.inf}  # classes and their ends [m/s]


@dataclass(frozen=True)
class PairedSession:
    """A session whose pairs were made.

    Attributes
    ----------
    name : str
        Name of the session.
    in_dir : path
        Folder with the results of earlier chapters: ``pairs``, and for `compare_compensated` also
        ``pairs-corrected`` and ``alignment``.
    """

    name: str
    in_dir: str | Path

    @cached_property
    def stamps_us(self) -> list[int]:
        """Stamps of all scans [us]."""
        return list_pairs(Path(self.in_dir, "pairs", self.name))

    def sample(self, n: int) -> list[int]:
        """List the stamps of n scans evenly spread over the session; all if there are fewer."""
        return self.stamps_us[:: max(1, len(self.stamps_us) // n)][:n]

    def pair(self, us: int) -> tuple[np.ndarray, np.ndarray]:
        """Read the radar image and the lidar image of a scan, shape (w, w), uint8."""
        return load_pair(Path(self.in_dir, "pairs", self.name), us)

    def lidar(self, us: int) -> np.ndarray:
        """Read the lidar points of a scan, shape (m, 2) [m]."""
        return image_to_points(self.pair(us)[1])


@dataclass(frozen=True)
class GeneratedSession(PairedSession):
    """A session whose lidar images were generated.

    Attributes
    ----------
    out_dir, sessions_root : path
        Folder with the generated images (``fake``), and folder of the sessions.
    points : mapping
        ``threshold`` and ``thin`` of `rol.bev.image_to_points`, for the generated images.
    """

    out_dir: str | Path
    sessions_root: str | Path
    points: Mapping[str, Any]

    def image(self, us: int) -> np.ndarray:
        """Read the generated image of a scan, shape (w, w), uint8."""
        return read_image(Path(self.out_dir, "fake", self.name, f"{us}.png"))

    def generated(self, us: int, **points: Any) -> np.ndarray:
        """Convert the generated image into points, shape (n, 2) [m]; options replace those of `points`."""
        return image_to_points(self.image(us), **{**self.points, **points})

    def detected(self, us: int) -> dict[str, np.ndarray]:
        """Detect points in the scan by each of ``rol_beyond.front_ends.DETECTORS``, shape (n, 2) [m]."""
        scan = load_radar(open_session(Path(self.sessions_root, self.name)).radar_path(us))
        return {name: detect_points(scan.power, scan.azimuths, detector=name) for name in DETECTORS}


def compare_scans(session: GeneratedSession, edges: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
    """Compare generated and lidar points of every scan of a session.

    Parameters
    ----------
    session : GeneratedSession
        The session.
    edges : array, shape (k + 1,)
        Edges of the histograms [m].

    Returns
    -------
    table : pandas.DataFrame
        One row per scan: ``radar_stamp_us`` and the columns of `rol.similarity.similarity_summary`.
    counts : array, shape (2, k)
        Histograms of the distances over all scans, from generated to lidar points and back.
    """
    rows, counts = [], np.zeros((2, len(edges) - 1), dtype=np.int64)
    for us in session.stamps_us:
        generated, lidar = session.generated(us), session.lidar(us)
        distances = nn_distances(generated, lidar), nn_distances(lidar, generated)
        rows.append({"radar_stamp_us": us, **summarize_distances(*distances)})
        for row, values in zip(counts, distances, strict=True):
            row += distance_histogram(values, edges)
    return pd.DataFrame(rows), counts


def brightest_pixels(radar_image: np.ndarray, n: int, pixel_size: float = 0.25) -> np.ndarray:
    """Find the n brightest pixels of a radar image within its range.

    Parameters
    ----------
    radar_image : array, shape (w, w), uint8
        Power.
    n : int
        Number of pixels; of equal ones the first rows count.
    pixel_size : float
        Edge of a pixel [m].

    Returns
    -------
    points : array, shape (n, 2)
        Centres of the pixels [m].
    """
    within = image_to_points(np.full_like(radar_image, 255), pixel_size=pixel_size)
    middle = (len(radar_image) - 1) / 2.0
    power = radar_image[tuple(np.rint(middle - within.T / pixel_size).astype(int))]
    return within[np.argsort(-power.astype(int), kind="stable")[:n]]


def compare_controls(sessions: Iterable[GeneratedSession], n_scans: int) -> pd.DataFrame:
    """Compare generated points and controls with the lidar points.

    Parameters
    ----------
    sessions : iterable of GeneratedSession
        The sessions.
    n_scans : int
        Scans per session.

    Returns
    -------
    table : pandas.DataFrame
        One row per scan and kind of ``points``, with the columns of `rol.similarity.similarity_summary`:
        "fake" (generated points), "brightest" (as many pixels of the radar image, see `brightest_pixels`),
        "chance" (generated points against the lidar points half a session away), and the detectors.
    """
    rows = []
    for session in sessions:
        stamps = session.sample(n_scans)
        for us, other_us in zip(stamps, np.roll(stamps, len(stamps) // 2), strict=True):
            radar, lidar = session.pair(us)
            points, real = session.generated(us), image_to_points(lidar)
            clouds = {
                "fake": (points, real),
                "brightest": (brightest_pixels(radar, len(points)), real),
                "chance": (points, session.lidar(other_us)),
                **{name: (peaks, real) for name, peaks in session.detected(us).items()},
            }
            rows += [{"points": name, **similarity_summary(*two)} for name, two in clouds.items()]
    return pd.DataFrame(rows)


def compare_compensated(sessions: Iterable[GeneratedSession]) -> pd.DataFrame:
    """Compare generated and lidar points at mid-scan, both motion-compensated.

    Parameters
    ----------
    sessions : iterable of GeneratedSession
        The sessions, with ``pairs-corrected`` and ``alignment``.

    Returns
    -------
    table : pandas.DataFrame
        One row per scan: the columns of `rol.similarity.similarity_summary`, ``radar_stamp_us``, ``vx_mps``
        and ``speed``, its class of `SPEEDS`.
    """
    rows = []
    for session in sessions:
        path = Path(session.in_dir, "alignment", session.name, "alignment.csv")
        motion = pd.read_csv(path).set_index("radar_stamp_us")
        twists = motion.loc[session.stamps_us, ["vx_mps", "vy_mps", "yaw_rate_radps"]].to_numpy()
        clouds = read_points(Path(session.out_dir, "fake", session.name), session.stamps_us, twists)
        for us, twist, generated in zip(session.stamps_us, twists, clouds, strict=True):
            lidar = load_pair(Path(session.in_dir, "pairs-corrected", session.name), us)[1]
            scores = similarity_summary(generated, image_to_points(lidar))
            rows.append({"radar_stamp_us": us, "vx_mps": twist[0], **scores})
    table = pd.DataFrame(rows)
    ends = [-np.inf, *SPEEDS.values()]
    return table.assign(speed=pd.cut(table.vx_mps, ends, labels=list(SPEEDS)))


def compare_thresholds(
    sessions: Iterable[GeneratedSession], n_scans: int, levels: Sequence[int]
) -> pd.DataFrame:
    """Compare generated and lidar points for several thresholds on the grey value.

    Parameters
    ----------
    sessions : iterable of GeneratedSession
        The sessions.
    n_scans : int
        Scans per session.
    levels : sequence of int
        Thresholds.

    Returns
    -------
    table : pandas.DataFrame
        Means over the scans of `rol.similarity.similarity_summary`; the index is the threshold.
    """
    rows = []
    for session in sessions:
        for us in session.sample(n_scans):
            lidar = session.lidar(us)
            for level in levels:
                points = session.generated(us, threshold=int(level))
                rows.append({"threshold": int(level), **similarity_summary(points, lidar)})
    return pd.DataFrame(rows).groupby("threshold").mean()


def network_points(
    radar_image: np.ndarray, networks: Mapping[str, TrainedNetwork], bf16: bool = False
) -> dict[str, np.ndarray]:
    """Convert a radar image into points by several networks.

    Parameters
    ----------
    radar_image : array, shape (w, w), uint8
        Power.
    networks : mapping of str to TrainedNetwork
        The networks by name.
    bf16 : bool
        Compute in bfloat16.

    Returns
    -------
    clouds : dict of array, shape (n, 2)
        Name -> points in the radar frame [m]; of a network that thins its strokes also without thinning, as
        "<name>, not thinned".
    """
    clouds = {}
    for name, network in networks.items():
        image = generate(network.generator, radar_image, bf16=bf16)
        clouds[name] = image_to_points(image, **network.points)
        if network.points["thin"]:
            clouds[f"{name}, not thinned"] = image_to_points(image, **{**network.points, "thin": False})
    return clouds


def compare_networks(
    sessions: Iterable[PairedSession],
    n_scans: int,
    networks: Mapping[str, TrainedNetwork],
    bf16: bool = False,
) -> Iterator[dict[str, Any]]:
    """Compare the points of networks with the lidar points.

    Parameters
    ----------
    sessions : iterable of PairedSession
        The sessions.
    n_scans : int
        Scans per session.
    networks, bf16
        As of `network_points`.

    Yields
    ------
    row : dict
        One per scan and network: ``session``, ``radar_stamp_us``, ``network``, and the entries of
        `rol.similarity.similarity_summary`.
    """
    for session in sessions:
        for us in session.sample(n_scans):
            about, lidar = {"session": session.name, "radar_stamp_us": us}, session.lidar(us)
            for name, points in network_points(session.pair(us)[0], networks, bf16).items():
                yield {**about, "network": name, **similarity_summary(points, lidar)}
