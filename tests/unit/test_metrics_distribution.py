"""Distances of sets of pictures: closed forms, matrix roots, invariants."""

import numpy as np
import pytest
from scipy import linalg

from fourd.metrics_distribution import frechet_distance, kernel_distance


def features(seed: int, count: int, size: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, size)) @ rng.normal(size=(size, size)) + rng.normal(size=size)


@pytest.mark.parametrize(("count_a", "count_b", "size"), [(40, 60, 5), (12, 9, 30)])
def test_frechet_distance_is_the_formula_with_matrix_roots(count_a, count_b, size):
    a, b = features(0, count_a, size), features(1, count_b, size)
    covariances = [np.cov(s, rowvar=False) for s in (a, b)]
    root = linalg.sqrtm(covariances[0] @ covariances[1] + (1e-10 if size > count_b else 0) * np.eye(size))
    expected = ((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum()
    expected += np.trace(covariances[0] + covariances[1] - 2 * np.real(root))
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-4)


def test_frechet_distance_of_a_shift_and_of_a_stretch():
    a = features(2, 50, 6)
    shift = np.arange(6.0)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(a, a + shift) == pytest.approx((shift**2).sum())
    # Of a stretch by s about the mean: (s - 1) ** 2 times the variances' sum.
    mean = a.mean(axis=0)
    stretched = mean + 1.5 * (a - mean)
    assert frechet_distance(a, stretched) == pytest.approx(0.25 * a.var(axis=0, ddof=1).sum())


def test_kernel_distance_is_the_mean_over_pairs():
    a, b = features(3, 6, 4), features(4, 5, 4)

    def k(x, y):
        return (x @ y / 4 + 1) ** 3

    pairs = [np.mean([k(s[i], s[j]) for i in range(len(s)) for j in range(len(s)) if i != j]) for s in (a, b)]
    expected = sum(pairs) - 2 * np.mean([k(x, y) for x in a for y in b])
    assert kernel_distance(a, b) == pytest.approx(expected)
    assert kernel_distance(a, b) == pytest.approx(kernel_distance(b, a))


def test_kernel_distance_is_unbiased():
    rng = np.random.default_rng(5)
    values = [kernel_distance(rng.normal(size=(8, 3)), rng.normal(size=(8, 3))) for _ in range(600)]
    assert abs(np.mean(values)) < 3 * np.std(values) / np.sqrt(len(values))


@pytest.mark.parametrize("distance", [frechet_distance, kernel_distance])
def test_too_few_pictures_or_other_features_are_refused(distance):
    with pytest.raises(ValueError, match="at least 2 features"):
        distance(np.zeros((1, 4)), np.zeros((5, 4)))
    with pytest.raises(ValueError, match="one length"):
        distance(np.zeros((5, 4)), np.zeros((5, 3)))
