"""Settings classes: a value out of its range is refused when the settings are made, with name, value and range."""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, get_type_hints

import numpy as np
import pytest

import rol
import rol_beyond
import rol_sim
import rol_study
from rol.evaluation import EvaluationError, FailureRule
from rol.geometry import check_fields
from rol.mcl import MclError, MclSettings, Measurement, MotionNoise, Resampling
from rol.odometry import IcpSettings, OdometryError
from rol.pairs import PairSettings
from rol.pix2pix import Pix2PixError, TrainConfig
from rol.training import RunOptions, TrainingError
from rol_beyond.likelihood_field import LikelihoodField
from rol_beyond.local_map_odometry import MapSettings
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import DetectionSettings, RecoverySettings
from rol_beyond.resampling import KldResampling
from rol_beyond.scan_matching import ScanToMapSettings
from rol_sim.sensors.radar import RadarSettings
from rol_sim.session.settings import SessionSettings, SettingsError, SimulationSettings
from rol_study.sampled_points import FrontEnd, SampledPointsError

NEEDED = {
    "AdaptationConfig": {"reach_m": 20.0},
    "RecoverySettings": {"reference_contrast": 0.2},
    "LocalizerSettings": {
        "filter": MclSettings(),
        "recovery": RecoverySettings(reference_contrast=0.2),
        "density_radius_m": 1.0,
    },
    "SearchSettings": {"reach_m": 30.0},
    "Surface": {"diffuse": 0.1},
    "SessionSettings": {"start": "2019-01-10T11:46:21"},
}
NAMES = ("Settings", "Config", "Rule", "Model", "FrontEnd", "Surface", "Noise", "Measurement", "Resampling")
NAMES += ("Field",)
PACKAGES = (rol, rol_beyond, rol_sim, rol_study)


def settings_classes(has_fields: Callable[[type], bool]) -> list[type]:
    """All dataclasses with settings of some kind."""
    modules = [
        importlib.import_module(found.name)
        for package in PACKAGES
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not found.name.endswith("__main__")
    ]
    classes = {one for module in modules for one in vars(module).values() if is_dataclass(one)}
    return sorted(
        (
            one
            for one in classes
            if isinstance(one, type) and one.__name__.endswith(NAMES) and has_fields(one)
        ),
        key=lambda one: one.__name__,
    )


def has_numbers(kind: type) -> bool:
    """Whether a class has fields that are numbers, and not only other settings."""
    return any(str(field.type).startswith(("int", "float", "tuple")) for field in fields(kind))


def usual(kind: type) -> Any:
    """Settings of a class with its defaults."""
    return kind(**NEEDED.get(kind.__name__, {}))


def parts(kind: type) -> dict[str, type]:
    """Fields that are settings classes themselves, or texts."""
    return {name: one for name, one in get_type_hints(kind).items() if is_dataclass(one) or one is str}


@pytest.mark.parametrize("kind", settings_classes(parts), ids=lambda kind: kind.__name__)
def test_every_part_of_any_settings_is_of_its_class(kind: type) -> None:
    settings = usual(kind)
    for name, part in parts(kind).items():
        for value in (None, part, IcpSettings if part is MotionNoise else MotionNoise()):
            with pytest.raises(ValueError, match=rf"^{name}"):
                replace(settings, **{name: value})


def test_the_classes_with_parts_are_all_there() -> None:
    names = {kind.__name__ for kind in settings_classes(parts)}
    assert names == {
        "KldResampling", "LocalMapSettings", "LocalizerSettings", "MclSettings", "PairSettings", "RecoverySettings", "ScanToMapSettings",
        "SessionSettings", "SimulationSettings",
    }  # fmt: skip


def test_an_object_with_the_methods_of_a_part_can_replace_it() -> None:
    class Exact:
        def sample(self, increment: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
            return np.tile(increment, (n, 1))

    for motion in (Exact(), MotionModel()):
        assert MclSettings(motion=motion).motion is motion


@pytest.mark.parametrize("kind", settings_classes(has_numbers), ids=lambda kind: kind.__name__)
def test_no_number_of_any_settings_may_be_nan(kind: type) -> None:
    settings, n = usual(kind), 0
    for field in fields(kind):
        is_many = str(field.type).startswith("tuple")
        if is_many or str(field.type) in ("int", "float"):
            value = np.nan if not is_many else (np.nan,) * len(getattr(settings, field.name))
            with pytest.raises(ValueError, match=rf"^{field.name}: .*nan.* is not .*in [(\[]"):
                replace(settings, **{field.name: value})
            n += 1
    assert n > 0


def test_the_classes_are_all_there() -> None:
    names = {kind.__name__ for kind in settings_classes(has_numbers)}
    assert names == {
        "AdaptationConfig", "ConfirmationSettings", "DetectionSettings", "FailureRule", "FrontEnd", "IcpSettings", "KldResampling",
        "LidarSettings", "LikelihoodField", "LocalizerSettings", "MapSettings", "MclSettings", "Measurement", "MotionModel", "MotionNoise", "PairSettings",
        "PlausibilitySettings", "RadarSettings", "RecoverySettings", "RelocalizationSettings", "Resampling",
        "RobustIcpSettings", "ScanToMapSettings", "SearchSettings", "SessionSettings", "SimulationSettings", "Surface",
        "TrainConfig",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "changes", "error", "message"),
    [
        (LikelihoodField, {"sigma_m": 0}, MclError, r"sigma_m: 0 is not in \(0, inf\)"),
        (Measurement, {"d_th_m": 0.0}, MclError, r"d_th_m: 0.0 is not in \(0, inf\)"),
        (MotionNoise, {"yaw_rad": -0.1}, MclError, r"yaw_rad: -0.1 is not in \[0, inf\)"),
        (Resampling, {"ess_fraction": 1.01}, MclError, r"ess_fraction: 1.01 is not in \[0, 1\]"),
        (MclSettings, {"n_particles": 0}, MclError, r"n_particles: 0 is not a whole number in \[1, inf\)"),
        (MclSettings, {"n_particles": 3.5}, MclError, "n_particles: 3.5 is not a whole number"),
        (Measurement, {"exponent": "20"}, MclError, "exponent: '20' is not in"),
        (Measurement, {"exponent": True}, MclError, "exponent: True is not in"),
        (
            KldResampling,
            {"scheme": "stratified"},
            MclError,
            "scheme: 'stratified' is none of multinomial, systematic",
        ),
        (IcpSettings, {"trim": 0.0}, OdometryError, r"trim: 0.0 is not in \(0, 1\]"),
        (ScanToMapSettings, {"range_m": 0.0}, OdometryError, r"range_m: 0.0 is not in \(0, inf\]"),
        (DetectionSettings, {"lost_below": 1.5}, ValueError, "lost_below: 1.5 is not in"),
        (RecoverySettings, {"reference_contrast": 0.0}, ValueError, "reference_contrast: 0.0 is not in"),
        (
            MotionModel,
            {"sigma_base": (0.1, -0.1, 0.0)},
            ValueError,
            r"sigma_base: \(0.1, -0.1, 0.0\) is not in",
        ),
        (MapSettings, {"cell_m": -1.0}, ValueError, "cell_m: -1.0 is not in"),
        (FailureRule, {"seconds": -1.0}, EvaluationError, "seconds: -1.0 is not in"),
        (TrainConfig, {"batch_size": 0}, Pix2PixError, "batch_size: 0 is not a whole number in"),
        (PairSettings, {"pixel_size": 0.0}, ValueError, r"pixel_size: 0.0 is not in \(0, inf\)"),
        (FrontEnd, {"fraction_1m": 40.0}, SampledPointsError, "fraction_1m: 40.0 is not in"),
        (RadarSettings, {"layer_widths_deg": (0.8, 0.0)}, ValueError, "layer_widths_deg: .* is not in"),
        (SimulationSettings, {"loop_m": 10.0}, SettingsError, r"loop_m: 10.0 is not in \[450, inf\)"),
        (SessionSettings, {"changed_share": 0.4}, SettingsError, r"changed_share: 0.4 is not in \[0, 0.3\]"),
        (SessionSettings, {"start": "noon"}, SettingsError, "start: 'noon' is not a date and time"),
        (SessionSettings, {"start": None}, SettingsError, "start: expected str, got None"),
        (MclSettings, {"measurement": Resampling()}, MclError, "measurement: expected Measurement, got Res"),
        (RadarSettings, {"surfaces": {"WALL": 0.3}}, ValueError, "surfaces: WALL: expected Surface, got 0.3"),
        (SimulationSettings, {"sessions": {"sim-a": {}}}, SettingsError, "sim-a: expected SessionSettings"),
        (RunOptions, {"metadata": None}, TrainingError, "metadata: expected Mapping, got None"),
        (IcpSettings, {"trim": (0.5, 0.5)}, OdometryError, r"trim: \(0.5, 0.5\) is not in"),
    ],
)
def test_values_out_of_range_are_named(kind: type, changes: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        replace(usual(kind), **changes)


def test_bounds_count_as_their_brackets_say() -> None:
    @dataclass
    class One:
        value: Any

    for value, span in (
        (0, "[0, 1)"),
        (np.float32(0.5), "(0, 1)"),
        (np.inf, "(0, inf]"),
        (((1,), (2,)), "[1, 2]"),
    ):
        check_fields(One(value), {span: "value"})
    for value, span in (
        (1, "[0, 1)"),
        (0, "(0, 1)"),
        (np.inf, "(0, inf)"),
        (((1,), (3,)), "[1, 2]"),
        (None, "[0, 1]"),
    ):
        with pytest.raises(ValueError, match="value: "):
            check_fields(One(value), {span: "value"})
