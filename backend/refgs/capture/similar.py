"""Find photos that show the same part of a scene, by their image features.

A photo is described by one vector (VLAD: Jégou et al. 2010; normalised as by Arandjelović and Zisserman 2013). The features of all photos
are clustered by k-means. Each feature of a photo is assigned to the nearest mean. For each mean, the vector holds the sum of (feature −
mean) over the features assigned to this mean. The means are made of the photos themselves, so that nothing is downloaded. A vector takes
milliseconds; matching the features of two photos takes tenths of a second.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from scipy.cluster.vq import kmeans2

WORDS = 256
SAMPLE = 200  # features of each photo that the means are made of
ROUNDS = 10  # of k-means
NEXT = 5  # photos by name that each one is matched with where there are many
RANKS = *range(8), 9, 11, 14, 18, 24, 32, 43  # by likeness, of the photos that each one is paired with


def pairs_to_match(count: int, read: Callable[[int], np.ndarray], all_pairs: int) -> list[tuple[int, int]]:
    """Choose which of `count` photos to match. Returns pairs of indices, the smaller one first, sorted.

    With up to `all_pairs` photos, every pair is matched. With more, each photo is matched with two groups:

    - Up to NEXT photos that follow it. In a video, or a walk around the object, they were taken nearby.
    - Some photos that look similar (see `similar_pairs`, which calls `read`). They link several walks around the object. They also help if
      the file names do not follow the camera's path.
    """
    if count <= all_pairs:
        return list(combinations(range(count), 2))
    following = {(a, b) for a in range(count) for b in range(a + 1, min(a + NEXT + 1, count))}
    return sorted(following | similar_pairs(read, count, beside=NEXT))


def similar_pairs(read: Callable[[int], np.ndarray], count: int, beside: int) -> set[tuple[int, int]]:
    """Pair each of `count` photos with others that look like it. Return pairs of indices, the smaller one first.

    `read(index)` returns the descriptors of a photo's features, (M, D) of any dtype. It is called twice for each photo. Photos whose
    indices differ by at most `beside` are not paired. For each photo, the others are sorted by likeness, the most similar first, and those
    at the positions RANKS are taken. RANKS skips some positions, to reach farther down the list. The most similar photos were all taken
    from nearby. Photos from other rounds around the object come later. The same photos always give the same pairs.
    """
    random = np.random.default_rng(0)
    sample = np.concatenate([random.permutation(read(index))[:SAMPLE] for index in range(count)])
    if len(sample) <= WORDS:
        return set()
    means = kmeans2(_unit(sample), WORDS, iter=ROUNDS, minit="points", rng=random)[0]
    vectors = np.stack([_describe(_unit(read(index)), means) for index in range(count)])
    pairs = set()
    for one, likeness in enumerate(vectors @ vectors.T):
        order = [other for other in np.argsort(-likeness, kind="stable").tolist() if abs(other - one) > beside]
        chosen = [order[rank] for rank in RANKS if rank < len(order)]
        pairs.update((min(one, other), max(one, other)) for other in chosen)
    return pairs


def _unit(rows: np.ndarray) -> np.ndarray:
    """Return the rows as float32, divided by their lengths. Rows of zeros stay."""
    rows = rows.astype(np.float32)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)


def _describe(features: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Return a photo's VLAD vector (WORDS · D,) of length 1, zero without features."""
    word = np.argmax(features @ means.T - (means**2).sum(axis=1) / 2, axis=1)
    sums = np.zeros_like(means)
    np.add.at(sums, word, features - means[word])
    return _unit(_unit(sums).reshape(1, -1))[0]
