"""How far a set of pictures lies from another as a whole, by features of each picture.

Neither is FID: that name belongs to one network's features. Both depend on the number of pictures,
so only sets of one size may be compared.
"""

import numpy as np

KERNEL_DEGREE = 3


def frechet_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Squared Frechet distance of the normal distributions with two sets' means and covariances.

    first: (N, D), second: (M, D) features, N and M at least 2; any D, since the trace of the root of
    the covariances' product is the nuclear norm of an (N, M) matrix.
    Raises ValueError for fewer pictures or different D.
    Source: Dowson, Landau, "The Frechet distance between multivariate normal distributions", Journal of
    Multivariate Analysis 1982; for pictures Heusel, Ramsauer, Unterthiner, Nessler, Hochreiter, NIPS 2017.
    """
    _check(first, second)
    mean_a, mean_b = first.mean(axis=0, dtype=np.float64), second.mean(axis=0, dtype=np.float64)
    a = (first - mean_a) / np.sqrt(len(first) - 1)
    b = (second - mean_b) / np.sqrt(len(second) - 1)
    shared = np.linalg.svd(a @ b.T, compute_uv=False).sum()
    spread = float((a * a).sum() + (b * b).sum() - 2 * shared)
    return float(((mean_a - mean_b) ** 2).sum()) + max(spread, 0.0)


def kernel_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Squared maximum mean discrepancy with the kernel (x y / D + 1) ** 3, unbiased, so it may be negative.

    first: (N, D), second: (M, D) features, N and M at least 2. Raises ValueError as `frechet_distance`.
    Source: Binkowski, Sutherland, Arbel, Gretton, "Demystifying MMD GANs", ICLR 2018.
    """
    _check(first, second)
    x, y = first.astype(np.float64), second.astype(np.float64)
    within = [_kernel(s, s) for s in (x, y)]
    same = [float((k.sum() - np.trace(k)) / (len(k) * (len(k) - 1))) for k in within]
    return same[0] + same[1] - 2 * float(_kernel(x, y).mean())


def _kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x @ y.T / x.shape[1] + 1) ** KERNEL_DEGREE


def _check(first: np.ndarray, second: np.ndarray) -> None:
    if min(len(first), len(second)) < 2 or first.shape[1:] != second.shape[1:]:
        raise ValueError(
            f"expected two sets of at least 2 features of one length, got {first.shape}, {second.shape}"
        )
