"""Settings of simulated sessions: the section `simulated:` of a config file."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml

from rol.files import read_text
from rol.geometry import check_fields
from rol_sim.sensors.lidar import LidarSettings
from rol_sim.sensors.radar import RadarSettings

SWEEPS = ("nearest", "all", "none")


class SettingsError(ValueError):
    """A setting does not exist or its value is invalid."""


@dataclass(frozen=True)
class SessionSettings:
    """One session: when, how long, how it is driven, and what it meets.

    Attributes
    ----------
    start : str
        Date and time of the first radar scan, UTC, such as "2019-01-10T11:46:21".
    scans : int
        Radar scans, 4 a second.
    seed : int
        Draws all that differs between sessions.
    cruise_mps : float
        Speed on free, straight road [m/s].
    stops : int
        Junctions at which the car waits.
    stand_s : float
        How long the car stands at the start [s].
    parked_share : float
        Fraction of the parking places that are taken, 0 .. 1.
    leaf_density : float
        Leaves on the trees, 1 is usual.
    changed_share : float
        Fraction of the street furniture changed and, times three, of the hedges cut, 0 .. 0.3.
    vehicles, people : int
        Traffic: how many there are in the town, or how many come towards the car in a minute of the route.
    sweeps : str
        As in `SimulationSettings`, for this session; empty: as there.
    poses : str
        World "route" only: number of the pose file that is driven, such as "02". Speed, stops and the time of
        standing are then the true ones.
    first_scan : int
        World "route" only: where in the pose file the session begins. With `scans` 0 it goes on to the end.

    Raises
    ------
    SettingsError
        If a value is out of its range or `start` is no date and time; the message names it.
    """

    start: str
    scans: int = 240
    seed: int = 1
    cruise_mps: float = 9.0
    stops: int = 1
    stand_s: float = 1.0
    parked_share: float = 0.6
    leaf_density: float = 1.0
    changed_share: float = 0.08
    vehicles: int = 16
    people: int = 14
    sweeps: str = ""
    poses: str = ""
    first_scan: int = 0

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "cruise_mps",
            "[0, inf)": "scans seed stops stand_s leaf_density vehicles people first_scan",
            "[0, 1]": "parked_share",
            "[0, 0.3]": "changed_share",
            ("", *SWEEPS): "sweeps",
        }
        check_fields(self, allowed, SettingsError)
        try:
            self.first_stamp_us  # noqa: B018 (only to see whether it can be read)
        except ValueError as error:
            raise SettingsError(f"start: {self.start!r} is not a date and time: {error}") from error

    @property
    def first_stamp_us(self) -> int:
        """The start as a time [us]."""
        start = datetime.datetime.fromisoformat(self.start).replace(tzinfo=datetime.UTC)
        return int(start.timestamp()) * 1_000_000 + start.microsecond


@dataclass(frozen=True)
class SimulationSettings:
    """Settings common to all sessions of a config, and the sessions.

    Attributes
    ----------
    sessions : dict of str to SessionSettings
        The sessions by name.
    seed : int
        Draws the town.
    loop_m : float
        Length of the loop that the sessions drive along [m].
    relief_m : float
        How far the land away from the loop rises and falls [m].
    start_m : float
        Where on the loop the sessions start, each 1 to 4 m off [m].
    radar_height_m : float
        Height of the radar above the ground [m].
    sweeps : str
        "nearest": only the sweeps nearest to a scan's stamp and to its middle are made; "all": every one;
        "none".
    labels_every : int
        Of every n-th sweep the true materials are written as well; 0 for none.
    odometry_scale : float
        Spread of the forward scale error of gt/radar_odometry.csv, drawn once per session.
    odometry_yaw_rad : float
        Spread of its heading error per scan [rad].
    world : str
        "town": a town drawn from the seed; "route": the world of the real lidar map, driven along real poses.
    real_root : str
        World "route" only: folder of the real data; may be empty, see `rol_data.rall.find_real_root`.
    unmapped_share : float
        World "route" only: things that the map does not show, as a fraction of the groups of cells that it
        shows.
    lidar, radar : dict
        Settings of `LidarSettings` and `RadarSettings` other than the usual ones.

    Raises
    ------
    SettingsError
        If a value is out of its range; the message names it.
    """

    sessions: dict[str, SessionSettings] = field(default_factory=dict)
    seed: int = 1
    loop_m: float = 600.0
    relief_m: float = 1.0
    start_m: float = 20.0
    radar_height_m: float = 2.0
    sweeps: str = "nearest"
    labels_every: int = 20
    odometry_scale: float = 0.0015
    odometry_yaw_rad: float = 2.0e-4
    world: str = "town"
    real_root: str = ""
    unmapped_share: float = 1.8
    lidar: dict[str, Any] = field(default_factory=dict)
    radar: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        allowed = {
            "[450, inf)": "loop_m",  # shorter loops are too small for streets with houses
            "(0, inf)": "radar_height_m",
            "[0, inf)": "seed relief_m labels_every odometry_scale odometry_yaw_rad unmapped_share",
            "(-inf, inf)": "start_m",
            SWEEPS: "sweeps",
            ("town", "route"): "world",
        }
        check_fields(self, allowed, SettingsError)


def parse_settings(section: Mapping[str, Any], where: str = "simulated") -> SimulationSettings:
    """Read the `simulated:` section of a config.

    Parameters
    ----------
    section : mapping
        The section; keys are the attributes of `SimulationSettings`, `sessions` maps names to mappings.
    where : str
        What the section is called in messages, such as the file's name.

    Returns
    -------
    settings : SimulationSettings
        Checked settings.

    Raises
    ------
    SettingsError
        If a key is unknown, or a value has the wrong type or is out of its range; the message names it.
    """
    section = dict(_as_mapping(section, where))
    sessions = {}
    for name, values in _as_mapping(section.pop("sessions", {}), f"{where}: sessions").items():
        place = f"{where}: session {name}"
        if not str(name).startswith("sim-"):
            raise SettingsError(f"{place}: names of simulated sessions begin with 'sim-'")
        values = _as_mapping(values, place)
        if "start" not in values:
            raise SettingsError(f"{place}: the key 'start' is missing")
        session = _fill(SessionSettings, values, place)
        if section.get("world") == "route" and not session.poses:
            raise SettingsError(
                f"{place}: the key 'poses' is missing, the number of a pose file of the real route"
            )
        if session.scans < 3 and not (section.get("world") == "route" and session.scans == 0):
            raise SettingsError(
                f"{place}: scans: {session.scans} is too few, 3 are needed for one odometry increment"
            )
        sessions[str(name)] = session
    return _fill(SimulationSettings, section, where, sessions=sessions)


def load_settings(path: Path | str) -> SimulationSettings:
    """Read the `simulated:` section of a config file in YAML.

    Parameters
    ----------
    path : path
        The config file.

    Returns
    -------
    settings : SimulationSettings
        Checked settings.

    Raises
    ------
    SettingsError
        If the file cannot be read, has no such section, or a setting is at fault.
    """
    try:
        content = yaml.safe_load(read_text(path))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise SettingsError(f"{path}: cannot be read: {error}") from error
    if not isinstance(content, Mapping) or "simulated" not in content:
        raise SettingsError(f"{path}: no section 'simulated'")
    return parse_settings(content["simulated"], f"{path}: simulated")


def read_settings(path: Path | str) -> SimulationSettings:
    """Read the settings that a session was made with back from its `settings.json`.

    Parameters
    ----------
    path : path
        `settings.json` in the session's folder; the folder has the session's name.

    Returns
    -------
    settings : SimulationSettings
        The shared settings and this one session.

    Raises
    ------
    SettingsError
        If the file cannot be read or a setting is at fault.
    """
    path = Path(path)
    try:
        values = json.loads(read_text(path))
        shared = {key: value for key, value in values.items() if key not in ("format", "session")}
        section = {**shared, "sessions": {path.absolute().parent.name: values["session"]}}
    except (OSError, ValueError, AttributeError, KeyError) as error:
        raise SettingsError(f"{path}: cannot be read: {error!r}") from error
    return parse_settings(section, str(path))


def describe(settings: SimulationSettings, name: str) -> dict[str, Any]:
    """Return all settings of one session as plain values, for its JSON files.

    Parameters
    ----------
    settings : SimulationSettings
        The settings.
    name : str
        The session.

    Returns
    -------
    values : dict
        The shared settings and, under "session", the session's own.

    Raises
    ------
    SettingsError
        If there is no such session; the message lists those there are.
    """
    if name not in settings.sessions:
        raise SettingsError(
            f"no session {name!r} in the settings; there are: {', '.join(settings.sessions) or 'none'}"
        )
    values = asdict(settings)
    del values["sessions"], values["real_root"]  # where the real data lie changes nothing in a session
    return {**values, "session": asdict(settings.sessions[name])}


def sensor_settings(settings: SimulationSettings) -> tuple[LidarSettings, RadarSettings]:
    """Return the settings of both sensors, the defaults where nothing else is given.

    Parameters
    ----------
    settings : SimulationSettings
        The settings of all sessions.

    Returns
    -------
    lidar : LidarSettings
        Of both lidars.
    radar : RadarSettings
        Of the radar, its height included.

    Raises
    ------
    SettingsError
        If a sensor has no such setting, or its value is out of its range.
    """
    radar = {"height": settings.radar_height_m, **settings.radar}
    return _fill_sensor(LidarSettings, settings.lidar, "lidar"), _fill_sensor(RadarSettings, radar, "radar")


def _fill_sensor(kind: type, values: dict[str, Any], name: str) -> Any:
    known = [f.name for f in fields(kind)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise SettingsError(f"simulated: {name}: unknown key {unknown[0]!r}; known are: {', '.join(known)}")
    try:
        return kind(
            **{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        )
    except ValueError as error:
        raise SettingsError(f"simulated: {name}: {error}") from error


def _as_mapping(value: Any, where: str) -> Mapping[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise SettingsError(f"{where}: expected keys and values, got {value!r}")
    return value


def _fill(kind: type, values: Mapping[str, Any], where: str, **others: Any) -> Any:
    """Create settings from values; refuse unknown keys, other types and values out of range."""
    values = _check_types(kind, values, where)
    try:
        return kind(**others, **values)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def _check_types(kind: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Refuse keys that the dataclass lacks and values of another type; whole numbers pass as floats."""
    known = {f.name: str(f.type) for f in fields(kind) if f.name != "sessions"}
    checked = {}
    for key, value in values.items():
        if key not in known:
            raise SettingsError(f"{where}: unknown key {key!r}; known are: {', '.join(known)}")
        if known[key] == "float" and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if key == "start" and isinstance(value, datetime.datetime):  # yaml reads a bare date as one
            value = value.replace(tzinfo=None).isoformat()
        wanted = {"float": float, "int": int, "str": str}.get(known[key], dict)
        if not isinstance(value, wanted) or isinstance(value, bool):
            raise SettingsError(f"{where}: {key}: expected {wanted.__name__}, got {value!r}")
        checked[key] = value
    return checked
