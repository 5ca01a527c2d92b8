"""Settings of the method `robust`, next to those of the paper's method.

The robust filter is the paper's (`rol.mcl`) with another measurement (`rol_beyond.likelihood_field`), another
resampling (`rol_beyond.resampling`), a calibrated motion model (`rol_beyond.motion`) and recovery
(`rol_beyond.recovery`).
"""

from __future__ import annotations

from dataclasses import fields, replace

from rol.mcl import MclError, MclSettings
from rol_beyond.likelihood_field import LikelihoodField
from rol_beyond.resampling import KldResampling

METHODS = {
    "paper": MclSettings(),
    "robust": MclSettings(n_particles=1000, measurement=LikelihoodField(), resampling=KldResampling()),
}
_PARTS = "motion", "measurement", "resampling"


def settings_for(method: str, **changes: object) -> MclSettings:
    """Return the settings of a method by its name.

    Parameters
    ----------
    method : str
        "paper": matched counts to the power lambda, multinomial resampling after each scan. "robust": a
        likelihood field that down-weights dense map regions, and KLD-sampling with systematic resampling when
        the effective sample size falls below one half.
    **changes
        Values that differ from the method's, by the names of fields of `rol.mcl.MclSettings` or of its parts,
        such as ``exponent``. ``n_particles`` also bounds the number of particles of `KldResampling`.

    Returns
    -------
    settings : MclSettings

    Raises
    ------
    MclError
        If the method or a name is unknown, or a value is out of its range.
    """
    if method not in METHODS:
        raise MclError(f"unknown method {method!r}; available are {', '.join(sorted(METHODS))}")
    own = {field.name for field in fields(MclSettings)}
    settings = replace(METHODS[method], **{name: changes[name] for name in own & changes.keys()})
    left = {name: value for name, value in changes.items() if name not in own}
    if "n_particles" in changes and isinstance(settings.resampling, KldResampling):
        left = {"max_particles": changes["n_particles"], **left}
    for name, value in left.items():
        owner = [part for part in _PARTS if hasattr(getattr(settings, part), name)]
        if not owner:
            raise MclError(f"the method {method!r} has no setting {name!r}")
        settings = replace(settings, **{owner[0]: replace(getattr(settings, owner[0]), **{name: value})})
    return settings
