"""Compare the generated points of whole sessions with the lidar points: precision, recall and controls."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
from rol_beyond.front_ends import detect_points

SPEEDS = {"below 1": 1.0, "1 to 4": 4.0, "4 to 7": 7.0, "above 7": np.inf}  # classes and their ends [m/s]


@dataclass(frozen=True)
class GeneratedSession:
    """A session whose images were generated.

    Attributes
    ----------
    name : str
        Name of the session.
    in_dir, out_dir : path
        Folders with the results of earlier chapters (``pairs``, ``pairs-corrected``, ``alignment``), and with
        the generated images (``fake``).
    points : mapping
        ``threshold`` and ``thin`` of `rol.bev.image_to_points`, for the generated images.
    """

    name: str
    in_dir: str | Path
    out_dir: str | Path
    points: Mapping[str, Any]

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

    def image(self, us: int) -> np.ndarray:
        """Read the generated image of a scan, shape (w, w), uint8."""
        return read_image(Path(self.out_dir, "fake", self.name, f"{us}.png"))

    def generated(self, us: int, **points: Any) -> np.ndarray:
        """Convert the generated image into points, shape (n, 2) [m]; options replace those of `points`."""
        return image_to_points(self.image(us), **{**self.points, **points})

    def lidar(self, us: int) -> np.ndarray:
        """Read the lidar points of a scan, shape (m, 2) [m]."""
        return image_to_points(self.pair(us)[1])


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
    """Compare generated points with two controls.

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
        and "chance" (generated points against the lidar points half a session away).
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


def front_end_clouds(
    session: GeneratedSession,
    us: int,
    sessions_root: str | Path,
    networks: Mapping[str, TrainedNetwork],
    chosen: str,
    bf16: bool = False,
) -> dict[str, np.ndarray]:
    """Convert one scan into points by peak detectors and by networks.

    Parameters
    ----------
    session : GeneratedSession
        The session.
    us : int
        Stamp of the scan [us].
    sessions_root : path
        Folder of the sessions, for the polar scan.
    networks : mapping of str to TrainedNetwork
        The networks by name.
    chosen : str
        Name of the network whose images of the session exist; of a network that thins its strokes, points
        without thinning are added.
    bf16 : bool
        Compute in bfloat16.

    Returns
    -------
    clouds : dict of array, shape (n, 2)
        "k strongest", "CFAR", and the names of the networks -> points in the radar frame [m].
    """
    scan = load_radar(open_session(Path(sessions_root, session.name)).radar_path(us))
    clouds = {"k strongest": detect_points(scan.power, scan.azimuths)}
    clouds["CFAR"] = detect_points(scan.power, scan.azimuths, detector="cfar")
    for name, network in networks.items():
        if name == chosen:
            clouds[name] = session.generated(us)
        else:
            image = generate(network.generator, session.pair(us)[0], bf16=bf16)
            clouds[name] = image_to_points(image, **network.points)
    if chosen in networks and session.points["thin"]:
        clouds[f"{chosen}, not thinned"] = session.generated(us, thin=False)
    return clouds


def compare_front_ends(
    clouds: Iterable[tuple[str, int, Mapping[str, np.ndarray]]], sessions: Mapping[str, GeneratedSession]
) -> pd.DataFrame:
    """Compare the points of front ends with the lidar points.

    Parameters
    ----------
    clouds : iterable of (str, int, mapping)
        Session, stamp [us] and the points of every front end.
    sessions : mapping of str to GeneratedSession
        The sessions by name.

    Returns
    -------
    table : pandas.DataFrame
        One row per scan and front end: ``session``, ``radar_stamp_us``, ``front_end``, and the columns of
        `rol.similarity.similarity_summary`.
    """
    rows = []
    for name, us, points in clouds:
        lidar = sessions[name].lidar(us)
        about = {"session": name, "radar_stamp_us": us}
        rows += [{**about, "front_end": f, **similarity_summary(p, lidar)} for f, p in points.items()]
    return pd.DataFrame(rows)


def with_distances(clouds: Mapping[str, np.ndarray], lidar: np.ndarray) -> pd.DataFrame:
    """List the points of front ends with their distances to the lidar points, which come first.

    Parameters
    ----------
    clouds : mapping of str to array, shape (n, 2)
        Points of every front end [m].
    lidar : array, shape (m, 2)
        Lidar points [m].

    Returns
    -------
    table : pandas.DataFrame
        One row per point: ``front_end`` ("lidar" for the lidar points), ``x_m``, ``y_m`` and ``distance_m``.
    """
    tables = []
    for name, points in {"lidar": lidar, **clouds}.items():
        table = pd.DataFrame(points, columns=["x_m", "y_m"])
        table["distance_m"] = nn_distances(points, lidar)
        tables.append(table.assign(front_end=name))
    return pd.concat(tables, ignore_index=True)[["front_end", "x_m", "y_m", "distance_m"]]
