"""Settings classes: a value out of its range is refused when the settings are made, with name, value and range."""

import importlib
import pkgutil
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

import rol
import rol_beyond
import rol_data
import rol_sim
import rol_study
from rol.evaluation import EvaluationError, FailureRule
from rol.geometry import check_fields
from rol.mcl import MclError, MclSettings, settings_for
from rol.odometry import LocalMapSettings
from rol.pix2pix import Pix2PixError, TrainConfig
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import RecoverySettings
from rol_sim.sensors.radar import RadarSettings
from rol_sim.session.settings import SessionSettings, SettingsError, SimulationSettings
from rol_study.sampled_points import FrontEnd, SampledPointsError

NEEDED = {
    "RecoverySettings": {"level": 0.2},
    "Surface": {"diffuse": 0.1},
    "SessionSettings": {"start": "2019-01-10T11:46:21"},
}
NAMES = ("Settings", "Config", "Rule", "Model", "FrontEnd", "Surface")


def settings_classes() -> list[type]:
    """All dataclasses of the packages that hold settings."""
    modules = [
        importlib.import_module(found.name)
        for package in (rol, rol_beyond, rol_data, rol_sim, rol_study)
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not found.name.endswith("__main__")
    ]
    classes = {one for module in modules for one in vars(module).values() if is_dataclass(one)}
    return sorted(
        (one for one in classes if isinstance(one, type) and one.__name__.endswith(NAMES)),
        key=lambda one: one.__name__,
    )


def usual(kind: type) -> Any:
    """Settings of a class with its defaults."""
    return kind(**NEEDED.get(kind.__name__, {}))


@pytest.mark.parametrize("kind", settings_classes(), ids=lambda kind: kind.__name__)
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
    names = {kind.__name__ for kind in settings_classes()}
    assert names == {
        "FailureRule", "FrontEnd", "LidarSettings", "LocalMapSettings", "MclSettings", "MotionModel",
        "RadarSettings", "RecoverySettings", "SessionSettings", "Surface", "TrainConfig", "SimulationSettings",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "changes", "error", "message"),
    [
        (MclSettings, {"sigma_m": 0}, MclError, r"sigma_m: 0 is not in \(0, inf\)"),
        (MclSettings, {"d_th_m": 0.0}, MclError, r"d_th_m: 0.0 is not in \(0, inf\)"),
        (MclSettings, {"noise_yaw_rad": -0.1}, MclError, r"noise_yaw_rad: -0.1 is not in \[0, inf\)"),
        (MclSettings, {"resample_below": 1.01}, MclError, r"resample_below: 1.01 is not in \[0, 1\]"),
        (MclSettings, {"cell_m": 0}, MclError, "cell_m: 0 is not"),
        (MclSettings, {"n_particles": 0}, MclError, r"n_particles: 0 is not a whole number in \[1, inf\)"),
        (MclSettings, {"n_particles": 3.5}, MclError, "n_particles: 3.5 is not a whole number"),
        (MclSettings, {"exponent": "20"}, MclError, "exponent: 20 is not in"),
        (MclSettings, {"exponent": True}, MclError, "exponent: True is not in"),
        (
            MclSettings,
            {"resampling": "stratified"},
            MclError,
            "resampling: 'stratified' is none of multinomial, systematic",
        ),
        (MclSettings, {"likelihood": "beam"}, MclError, "likelihood: 'beam' is none of count, distance"),
        (RecoverySettings, {"level": 0.0}, ValueError, "level: 0.0 is not in"),
        (RecoverySettings, {"still_share": 0.0}, ValueError, "still_share: 0.0 is not in"),
        (MotionModel, {"driving": (0.1, -0.1, 0.0)}, ValueError, r"driving: \(0.1, -0.1, 0.0\) is not in"),
        (MotionModel, {"outlier_share": 2.0}, ValueError, "outlier_share: 2.0 is not in"),
        (LocalMapSettings, {"cell_m": -1.0}, ValueError, "cell_m: -1.0 is not in"),
        (FailureRule, {"seconds": -1.0}, EvaluationError, "seconds: -1.0 is not in"),
        (TrainConfig, {"batch": 0}, Pix2PixError, "batch: 0 is not a whole number in"),
        (TrainConfig, {"beta1": 1.0}, Pix2PixError, "beta1: 1.0 is not in"),
        (TrainConfig, {"network": "vnet"}, Pix2PixError, "network: 'vnet' is none of resnet, unet"),
        (TrainConfig, {"pixel_loss": "l2"}, Pix2PixError, "pixel_loss: 'l2' is none of l1, entropy"),
        (FrontEnd, {"share_1m": 40.0}, SampledPointsError, "share_1m: 40.0 is not in"),
        (RadarSettings, {"layer_widths_deg": (0.8, 0.0)}, ValueError, "layer_widths_deg: .* is not in"),
        (SimulationSettings, {"loop_m": 10.0}, SettingsError, r"loop_m: 10.0 is not in \[450, inf\)"),
        (SessionSettings, {"changed_share": 0.4}, SettingsError, r"changed_share: 0.4 is not in \[0, 0.3\]"),
        (SessionSettings, {"start": "noon"}, SettingsError, "start: 'noon' is not a date and time"),
    ],
)
def test_values_out_of_range_are_named(kind: type, changes: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        replace(usual(kind), **changes)


def test_changes_of_a_method_are_checked_too() -> None:
    with pytest.raises(MclError, match="sigma_m: 0 is not"):
        settings_for("rol", sigma_m=0)


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
