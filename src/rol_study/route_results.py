"""Tables of the chapters on the real route: runs of the filters by point quality, cause, odometry and place.

Rows of runs come from `rol_study.route_tables.row_of`, averages from `rol_study.route_tables.summarize_runs`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.evaluation import drift_by_length, pose_errors, rmse
from rol.geometry import accumulate_increments
from rol_study.oxford_route import RouteSession
from rol_study.published_truth import lateral_offsets
from rol_study.route_tables import CLASSES, summarize_runs

PAPER_NAMES = {"02": "seq01", "07": "seq02", "08": "seq03", "10": "seq04"}  # sessions in the paper's tables
CLASS_NAMES = dict(zip(CLASSES, ("1 m, 2°", "2 m, 5°", "5 m, 10°"), strict=True))
CAUSE_LABELS = {  # shorter names of `rol_study.route_tables.CAUSES`, for a table
    "matching distance of 2 m": "d_th of 2 m",
    "all false points last for 10 s": "lasting false points",
    "motion not compensated": "motion uncompensated",
    "flat weights and motion not compensated": "flat, uncompensated",
    "flat weights and lasting false points": "flat, lasting points",
}
SCAN_HZ = 4.0


def select_qualities(runs: pd.DataFrame, complete_from: float = 0.40) -> pd.DataFrame:
    """Select the runs of the curves over the quality of the points.

    Fractions from `complete_from` on share their sessions and seeds: those with a run at each of them. At a
    lower fraction, where a filter is lost and a run takes long, all runs at hand are used.

    Parameters
    ----------
    runs : pandas.DataFrame
        Runs of whole sessions, with ``session``, ``seed`` and ``fraction_1m``.
    complete_from : float
        Lowest fraction within 1 m of the map at which the same runs are required.

    Returns
    -------
    runs : pandas.DataFrame
        The selected ones, with ``is_complete``: the fraction has as many sessions and seeds as the others.
    """
    is_high = runs.fraction_1m >= complete_from
    n_qualities = runs[is_high].groupby(["session", "seed"]).fraction_1m.nunique()
    shared = n_qualities.index[n_qualities == n_qualities.max()]
    is_shared = pd.MultiIndex.from_frame(runs[["session", "seed"]]).isin(shared)
    chosen = runs[is_shared | ~is_high]
    pairs = chosen.session.str.cat(chosen.seed.astype(str), sep=" ")
    n_pairs = pairs.groupby(chosen.fraction_1m).transform("nunique")
    return chosen.assign(is_complete=n_pairs >= len(shared))


def spread(values: pd.Series, scale: float = 1.0, digits: int = 2) -> str:
    """Format the mean and the standard deviation of some values, such as "0.81 ± 0.33"."""
    mean, deviation = scale * values.mean(), scale * values.std(ddof=0)
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}"


def paper_tables(
    runs: pd.DataFrame, paper2: pd.DataFrame | None, paper3: pd.DataFrame | None
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Create the paper's Tables II and III from runs of several qualities, with the paper's rows.

    Parameters
    ----------
    runs : pandas.DataFrame
        Runs of one method.
    paper2, paper3 : pandas.DataFrame, optional
        The paper's tables, indexed by "seq01" to "seq04"; without them there are no rows of the paper.

    Returns
    -------
    table2, table3 : pandas.DataFrame
        One row per session and quality, mean and standard deviation over the seeds, as text; without rows
        and columns where there are no runs. "sound truth" leaves out scans with faulty ground truth.
    """
    table2, table3 = [], []
    for (number, quality), group in runs.groupby(["session", "fraction_1m"]):
        about = {"session": number, "within 1 m [%]": f"{100 * quality:.0f}", "runs": len(group)}
        table2.append(about | {
            "failures per run": f"{group.failures.mean():.1f}", "RMSE [m]": spread(group.rmse_m),
            "RMSE [deg]": spread(group.rmse_yaw_deg),
            "RMSE [m], sound truth": spread(group.rmse_sound_m.fillna(group.rmse_m)),
        })  # fmt: skip
        table3.append(about | {words: spread(group[name], 100, 1) for name, words in CLASS_NAMES.items()})
    known = sorted(set(runs.session) & set(PAPER_NAMES)) if paper2 is not None else []
    for number in known:
        about = {"session": number, "within 1 m [%]": "the paper", "runs": 1}
        printed, classes = paper2.loc[PAPER_NAMES[number]], 100 * paper3.loc[PAPER_NAMES[number]]
        table2.append(about | {
            "failures per run": f"{printed.failures:.1f}", "RMSE [m]": f"{printed.rmse_m:.2f}",
            "RMSE [deg]": f"{printed.rmse_yaw_deg:.2f}", "RMSE [m], sound truth": "",
        })  # fmt: skip
        table3.append(about | {words: f"{classes[name]:.1f}" for name, words in CLASS_NAMES.items()})
    tables = (pd.DataFrame(rows) for rows in (table2, table3))
    table2, table3 = (t.sort_values("session", kind="stable") if len(t) else t for t in tables)
    return table2, table3


def cause_table(causes: pd.DataFrame, paper2: pd.DataFrame, paper3: pd.DataFrame) -> pd.DataFrame:
    """Compare the causes of larger errors at each quality with the paper's means over four sessions.

    Parameters
    ----------
    causes : pandas.DataFrame
        The stored table "causes".
    paper2, paper3 : pandas.DataFrame
        The paper's tables.

    Returns
    -------
    table : pandas.DataFrame
        One row per cause, columns in two levels: quality, and RMSE [m], two classes [%] and failures per run.
    """
    names = {"rmse_m": "RMSE [m]", "within_1m_2deg": "1 m, 2° [%]", "within_5m_10deg": "5 m, 10° [%]"}
    names |= {"failures": "failures"}
    wide = summarize_runs(causes, ["cause", "fraction_1m"])[list(names)].unstack("fraction_1m")
    wide = wide.swaplevel(axis=1).sort_index(axis=1, level=0, sort_remaining=False)
    wide = wide.loc[list(dict.fromkeys(causes.cause))].rename(index=CAUSE_LABELS)
    means = paper2.join(100 * paper3[list(CLASSES)]).mean()
    wide.loc["the paper (mean)"] = [means[name] for _, name in wide.columns]
    wide = wide.rename(columns=names, level=1).rename(columns=lambda q: f"{100 * q:.0f} %", level=0)
    return wide.rename_axis(None).rename_axis(columns=[None, None])


def odometry_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Average the runs of sessions, qualities and seeds for which the true increments were tried, too.

    Parameters
    ----------
    runs : pandas.DataFrame
        From `rol_study.route_tables.load_runs`.

    Returns
    -------
    groups : pandas.DataFrame
        From `summarize_runs`, indexed by fraction_1m, session, odometry and method.
    """
    tried = runs.loc[runs.odometry == "true", ["session", "fraction_1m", "seed"]].drop_duplicates()
    return summarize_runs(runs.merge(tried), ["fraction_1m", "session", "odometry", "method"])


def describe_sessions(sessions: Mapping[str, RouteSession]) -> pd.DataFrame:
    """Describe the ground truth and the odometry of sessions.

    Parameters
    ----------
    sessions : mapping of str to RouteSession
        By number; lateral offsets are those from session "01", which made the map.

    Returns
    -------
    table : pandas.DataFrame
        One row per session: length [km], median and 95th percentile of the lateral offset from the mapping
        session's path [m], scans with faulty ground truth, drift of the odometry over 100 to 800 m.
    """
    rows = []
    for number, route in sessions.items():
        km = np.hypot(*np.diff(route.truth[:, :2], axis=0).T).sum() / 1000.0
        middle, most = np.nan, np.nan
        if "01" in sessions:
            offsets = np.abs(lateral_offsets(route.truth, sessions["01"].truth))
            middle, most = np.nanmedian(offsets), np.nanpercentile(offsets, 95)
        drift = drift_by_length(accumulate_increments(route.increments, route.truth[0]), route.truth)
        rows.append({
            "session": number, "in the paper": PAPER_NAMES.get(number, "map"), "scans": len(route.truth),
            "length [km]": km, "offset [m]": middle, "95 % [m]": most,
            "faulty scans": int(np.sum(route.is_faulty)), "drift [%]": drift.mean_translation_pct,
            "drift [deg / 100 m]": drift.mean_rotation_deg_per_100m,
        })  # fmt: skip
    return pd.DataFrame(rows)


def largest_standing_turn(sessions: Iterable[RouteSession]) -> tuple[float, float]:
    """Find the largest turn that the odometry reports during one stop of the vehicle.

    Parameters
    ----------
    sessions : iterable of RouteSession
        The sessions.

    Returns
    -------
    turned_deg, seconds : float
        Absolute change of heading [deg], and duration of that stop [s]; NaN without a stop.
    """
    stops = []
    for route in sessions:
        is_still = np.hypot(*route.true_increments[:, :2].T) < 0.005
        for stop in np.split(np.arange(len(is_still)), np.flatnonzero(np.diff(is_still)) + 1):
            if is_still[stop[0]]:
                turned = abs(np.rad2deg(route.increments[stop, 2].sum()))
                stops.append((float(turned), len(stop) / SCAN_HZ))
    return max(stops, default=(np.nan, np.nan))


def errors_by_speed(estimates: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> dict[str, float]:
    """Compute the RMSE of the position by speed, and how often the heading error is below 3 deg.

    Parameters
    ----------
    estimates, truths : sequence of array, shape (n, 3)
        Poses of each session [m, m, rad].

    Returns
    -------
    numbers : dict
        ``still_m`` below 0.5 m/s, ``slow_m`` and ``fast_m`` below and above the median speed of the other
        scans [m], ``heading_within`` [%]; NaN where there are no scans.
    """
    numbers = dict.fromkeys(("still_m", "slow_m", "fast_m", "heading_within"), np.nan)
    if not len(truths):
        return numbers
    errors = [pose_errors(*pair) for pair in zip(estimates, truths, strict=True)]
    off, turn = (np.concatenate([getattr(e, name) for e in errors]) for name in ("position_m", "yaw_rad"))
    steps = [np.hypot(*np.gradient(truth[:, :2], axis=0).T) for truth in truths]
    speed = SCAN_HZ * np.concatenate(steps)
    is_still = speed < 0.5
    is_fast = speed >= (np.median(speed[speed > 0.5]) if (speed > 0.5).any() else 0.5)
    chosen = {"still_m": is_still, "slow_m": ~is_still & ~is_fast, "fast_m": is_fast}
    for name, scans in chosen.items():
        numbers[name] = rmse(off[scans]) if scans.any() else np.nan
    return numbers | {"heading_within": float(100 * np.mean(np.abs(turn) < np.deg2rad(3.0)))}


def fraction_by_chance(
    map_points: np.ndarray, truth: np.ndarray, within_m: float = 1.0, reach_m: float = 64.0
) -> float:
    """Compute the fraction of points placed at random along a path that lie near the map.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        The map [m].
    truth : array, shape (n, 3)
        Poses along the path [m, m, rad].
    within_m, reach_m : float
        Distance that counts as near, and half the side of the square around a pose [m].

    Returns
    -------
    fraction : float
        Over a hundred points at each of a hundred poses.
    """
    rng = np.random.default_rng(0)
    places = truth[:: max(len(truth) // 100, 1), None, :2] + rng.uniform(-reach_m, reach_m, (100, 2))
    return float(np.mean(cKDTree(map_points).query(places)[0] < within_m))


def _name_filters(places: pd.DataFrame) -> pd.Series:
    """Name the filters at other places: "paper", "robust" and, where it is calibrated on Oxford, "oxford"."""
    return places.method.where(~places.calibrated_on.str.startswith("oxford"), "oxford")


def place_table(places: pd.DataFrame) -> pd.DataFrame:
    """Average the runs at other places over the seeds.

    Parameters
    ----------
    places : pandas.DataFrame
        The stored table "places".

    Returns
    -------
    table : pandas.DataFrame
        Indexed by place, session and fraction_1m; columns in two levels: ``rmse_m`` [m] or ``rmse_yaw_deg``
        [deg], and the filters of `place_numbers`.
    """
    by = [places.place, places.session, places.fraction_1m, _name_filters(places)]
    table = places[["rmse_m", "rmse_yaw_deg"]].groupby(by).mean().unstack()
    return table.reindex(columns=["paper", "robust", "oxford"], level=1)


def place_numbers(places: pd.DataFrame) -> dict[str, float]:
    """Summarize the runs at other places over sessions and seeds.

    Parameters
    ----------
    places : pandas.DataFrame
        The stored table "places".

    Returns
    -------
    numbers : dict
        By ``<place>_<quality>_<filter>_``: mean RMSE ``m`` and largest ``worst_m`` [m], and ``failures`` in
        all runs. The filters are "paper", "robust" (calibrated at the same place) and "oxford" (the method
        `robust` calibrated on Oxford). ``places_runs`` and ``places_sessions`` count runs of each filter and
        sessions, ``places_failures`` those of all runs.
    """
    filters = _name_filters(places)
    numbers = {
        "places_runs": int((filters == "paper").sum()),
        "places_sessions": int(places.groupby(["place", "session"]).ngroups),
        "places_failures": float(places.failures.sum()),
    }
    for (place, quality, name), group in places.groupby(["place", "fraction_1m", filters]):
        key = f"{place}_{100 * quality:.0f}_{name}"
        numbers |= {
            f"{key}_m": float(group.rmse_m.mean()),
            f"{key}_worst_m": float(group.rmse_m.max()),
            f"{key}_failures": float(group.failures.sum()),
        }
    return numbers


def peer_table(tuned: pd.DataFrame, registered: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Average the filters with better settings and the registration alone over the same sessions and seeds.

    Parameters
    ----------
    tuned, registered : pandas.DataFrame
        The stored tables "tuned" and "registration".
    runs : pandas.DataFrame
        Runs of both methods with the same points.

    Returns
    -------
    groups : pandas.DataFrame
        From `summarize_runs`, indexed by the name of the filter, the largest error first.
    """
    names = {what: f"paper, {what}" for what in tuned.what.unique()} | {"both": "paper with both"}
    peers = pd.concat([
        registered.assign(filter="registration alone"),
        runs.assign(filter=runs.method),
        tuned.assign(filter=tuned.what.map(names)),
    ])  # fmt: skip
    is_peer = peers.seed.isin({*tuned.seed} & {*registered.seed}) & peers.session.isin(tuned.session)
    groups = summarize_runs(peers[is_peer], ["filter"])
    return groups.sort_values("rmse_m", ascending=False, kind="stable")


def displaced_table(trials: pd.DataFrame) -> pd.DataFrame:
    """Count the displaced starts from which the error of the method `paper` shrank again.

    Parameters
    ----------
    trials : pandas.DataFrame
        The stored table "displaced".

    Returns
    -------
    table : pandas.DataFrame
        Indexed by distance_m and turn_deg, one column per fraction_1m: starts from which the position error
        fell below 2 m [%].
    """
    by = [trials.distance_m, trials.turn_deg, trials.fraction_1m]
    return 100.0 * np.isfinite(trials.below_2m_s).groupby(by).mean().unstack()


def trial_numbers(trials: pd.DataFrame, within_s: float) -> dict[str, float]:
    """Summarize trials with a wrong start.

    Parameters
    ----------
    trials : pandas.DataFrame
        Rows of `rol_study.route_experiments.RecoveryTrial`.
    within_s : float
        Time within which the pose should be found [s].

    Returns
    -------
    numbers : dict
        ``found`` and ``told`` [%], ``median_s`` and ``cpu_s`` [s], ``wrong`` trials that ended at a wrong
        pose reported as right, ``particles`` and the number ``n`` of trials.
    """
    is_found = np.isfinite(trials.found_s)
    return {
        "found": float(100 * (trials.found_s <= within_s).mean()),
        "median_s": float(trials.found_s[is_found].median()),
        "wrong": float((~is_found & ~trials.is_lost_at_end).sum()),
        "particles": float(trials.n_particles.max()),
        "told": float(100 * trials.told_share.dropna().mean()),
        "cpu_s": float(trials.seconds.median()),
        "n": len(trials),
    }
