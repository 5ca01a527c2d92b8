"""A start, guess or increment that is not one pose is refused with its name, wherever one is taken."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.mcl import build_matched_grid
from rol_beyond.front_ends import evaluate_on_map
from rol_beyond.local_map_odometry import (
    LocalMapOdometry,
    MapSettings,
    RobustIcpSettings,
    build_local_map,
    deskew_cloud,
    register_robust,
)
from rol_beyond.motion import gate_odometry
from rol_beyond.recovery import RecoveringFilter, RecoverySettings, measure_reference_contrast
from rol_beyond.robust import settings_for
from rol_beyond.scan_matching import correlative_scan_match, scan_to_map_icp
from rol_beyond.search import SearchSettings, search_poses

POINTS = np.random.default_rng(1).uniform(-20.0, 20.0, (60, 2))
GRID = build_matched_grid(POINTS)
LOCAL_MAP = build_local_map([POINTS], MapSettings())


def start_filter(pose: object) -> RecoveringFilter:
    recovery = RecoverySettings(reference_contrast=0.2)
    return RecoveringFilter(POINTS, pose, settings_for("robust"), recovery, np.random.default_rng(1))


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.zeros((1, 3)), np.zeros(2), 0.0, "here"])
@pytest.mark.parametrize(
    ("call", "name"),
    [
        (start_filter, "start pose"),
        (lambda pose: start_filter(np.zeros(3)).reset(pose), "start pose"),
        (lambda pose: start_filter(np.zeros(3)).step(POINTS, pose), "odometry increment"),
        (lambda pose: list(scan_to_map_icp([], [POINTS], POINTS, pose)), "start"),
        (lambda pose: correlative_scan_match(POINTS, POINTS, pose), "initial guess"),
        (lambda pose: register_robust(POINTS, LOCAL_MAP, pose, RobustIcpSettings()), "initial guess"),
        (lambda pose: LocalMapOdometry(first_twist=pose), "first twist"),
        (lambda pose: deskew_cloud(POINTS, pose), "twist"),
        (lambda pose: list(gate_odometry([pose])), "odometry increment"),
        (lambda pose: search_poses(POINTS, GRID, GRID, pose, SearchSettings(5.0)), "centre of the search"),
        (lambda pose: evaluate_on_map(POINTS, pose, cKDTree(POINTS)), "T_a_b"),
        (lambda pose: measure_reference_contrast([POINTS], [pose], GRID), "poses"),
    ],
)
def test_one_pose_is_asked_for_by_its_name(call, name: str, bad: object) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: (expected shape .*3\)|not an array of numbers)"):
        call(bad)
