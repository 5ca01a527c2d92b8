"""Resampling and settings of the method `robust`."""

import numpy as np
import pytest

from rol.geometry import transform_points
from rol.mcl import MclError, MclSettings, Measurement, ParticleFilter, localize
from rol_beyond.likelihood_field import LikelihoodField
from rol_beyond.resampling import KldResampling, kld_sample_size, resample_systematic
from rol_beyond.robust import settings_for


class TopOfRange:
    """A generator whose draws are the largest number below one, where cumulative sums round."""

    def random(self):
        return np.nextafter(1.0, 0.0)


def test_settings_by_name():
    assert settings_for("paper") == MclSettings()
    assert settings_for("paper", n_particles=7).n_particles == 7
    robust = settings_for("robust", n_particles=300, exponent=9.0, min_particles=50)
    assert robust.n_particles == robust.resampling.max_particles == 300
    assert robust.measurement == LikelihoodField(exponent=9.0) and robust.resampling.min_particles == 50
    assert settings_for("robust", n_particles=300, max_particles=100).resampling.max_particles == 100
    other = settings_for("robust", measurement=Measurement(d_th_m=1.0), cell_m=0.5)
    assert other.measurement == Measurement(d_th_m=1.0, cell_m=0.5)
    with pytest.raises(MclError, match="unknown method 'amcl'; available are paper, robust"):
        settings_for("amcl")
    with pytest.raises(MclError, match="the method 'robust' has no setting 'd_th_m'"):
        settings_for("robust", d_th_m=1.0)
    with pytest.raises(MclError, match="sigma_m: 0 is not"):
        settings_for("robust", sigma_m=0)


def test_systematic_resampling_copies_each_particle_in_proportion_to_its_weight():
    rng, weights = np.random.default_rng(6), np.array([0.45, 0.35, 0.0, 0.15, 0.05])
    copies = np.array([np.bincount(resample_systematic(weights, rng), minlength=5) for _ in range(20_000)])
    assert (copies.sum(axis=1) == 5).all() and (copies[:, 2] == 0).all()
    np.testing.assert_allclose(copies.mean(axis=0), 5 * weights, atol=0.03)
    assert np.abs(copies - 5 * weights).max() < 1.0  # never a full copy more or less
    for wrong, fault in (
        ([np.nan, 1.0], "finite"),
        ([-0.5, 1.5], "negative"),
        ([0.0, 0.0], "weights are zero"),
    ):
        with pytest.raises(MclError, match=fault):
            resample_systematic(np.array(wrong), rng)


def test_systematic_resampling_when_the_cumulative_sum_rounds_below_the_draw():
    weights = np.append(np.full(7, 1 / 7), 0.0)  # the running sum is 0.9999999999999998
    assert resample_systematic(weights, TopOfRange()).max() == 6


def test_sample_size_follows_the_spread():
    rng = np.random.default_rng(1)
    narrow, wide = (rng.normal(0.0, sigma, (4000, 3)) * (1.0, 1.0, 0.1) for sigma in (0.05, 1.0))
    assert kld_sample_size(np.zeros((50, 3))) == 1
    assert kld_sample_size(narrow) < 300 < kld_sample_size(wide)
    # one degree of freedom: 0.99 quantile of chi-square, 6.63
    two = np.array([[0.1, 0.1, 0.01], [9.1, 0.1, 0.01]])
    assert kld_sample_size(two) == pytest.approx(6.63 / (2 * 0.05), rel=0.05)


@pytest.mark.parametrize("scheme", ["systematic", "multinomial"])
def test_the_number_of_particles_stays_between_its_bounds(scheme):
    rng, wide = np.random.default_rng(2), np.random.default_rng(3).normal(0.0, 9.0, (4000, 3))
    resampling = KldResampling(min_particles=40, max_particles=500, scheme=scheme)
    assert len(resampling.draw(wide, np.full(4000, 1 / 4000), rng)) == 500
    assert len(resampling.draw(np.zeros((4000, 3)), np.full(4000, 1 / 4000), rng)) == 40


def test_the_filter_converges_to_a_corner_with_fewer_particles():
    wall = np.stack([np.arange(0.0, 40.0, 0.25), np.full(160, 5.0)], axis=1)
    points = np.concatenate([wall, np.stack([np.full(20, 40.0), np.arange(0.0, 5.0, 0.25)], axis=1)])
    truth = np.array([30.5, 0.4, 0.01])
    cloud = transform_points((0.0, 0.0, -truth[2]), points - truth[:2])
    settings = settings_for("robust", n_particles=1500, min_particles=40)
    grid, rng = settings.measurement.build_grid(points), np.random.default_rng(8)
    particle_filter = ParticleFilter(grid, (30.0, 0.0, 0.0), settings, rng)
    updates = list(localize(particle_filter, [np.zeros(3)] * 5, [cloud] * 6))
    assert np.hypot(*(updates[-1].pose - truth)[:2]) < 0.2 and updates[-1].inlier_ratio > 0.5
    assert len(updates[0].particles) == 1500 and 40 <= len(updates[-1].next_particles) < 1500
    assert updates[-1].next_weights.sum() == pytest.approx(1.0)
