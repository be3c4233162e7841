"""Test the choice of photos that show the same, by features that stand for places around an object."""

import numpy as np
import pytest

from refgs.capture.similar import APART, similar_pairs

PLACES = 90  # around the object, with features of their own
SHOWN = 12  # of them in each photo
EACH = 10  # features of a place


def descriptors(places: np.ndarray) -> list[np.ndarray]:
    """Make the descriptors of photos that are taken at `places` around an object, as SIFT has them: (M, 128) uint8 for each photo."""
    random = np.random.default_rng(0)
    known = random.gamma(0.6, 40, (PLACES, EACH, 128))
    photos = []
    for place in places:
        seen = known[(place + np.arange(SHOWN)) % PLACES].reshape(-1, 128)
        photos.append((seen + random.normal(0, 8, seen.shape)).clip(0, 255).astype(np.uint8))
    return photos


def away(places: np.ndarray, pairs: set[tuple[int, int]]) -> np.ndarray:
    """Return how many places the photos of each pair are from each other, around the object."""
    a, b = places[np.array(sorted(pairs))].T
    return np.minimum((a - b) % PLACES, (b - a) % PLACES)


@pytest.mark.parametrize("in_order", [True, False])
def test_photos_of_the_same_place_are_paired(in_order):
    """Check two rounds of a film, and the same photos in any order: each photo is paired with the one of the other round."""
    places = np.tile(np.arange(PLACES), 2)
    if not in_order:
        places = np.random.default_rng(1).permutation(places)
    photos = descriptors(places)
    pairs = similar_pairs(photos.__getitem__, len(photos), 6)
    assert pairs == similar_pairs(photos.__getitem__, len(photos), 6)
    assert all(b - a > APART for a, b in pairs) and len(pairs) <= 6 * len(photos)
    apart = away(places, pairs)
    assert (apart < SHOWN).mean() > 0.95
    assert (apart == 0).sum() > 0.9 * PLACES


def test_photos_without_features():
    photos = descriptors(np.arange(0, PLACES, 3))
    photos[4] = photos[9] = photos[4][:0]
    pairs = similar_pairs(photos.__getitem__, len(photos), 5)
    assert all(0 <= a < b < len(photos) for a, b in pairs) and (0, 3) in pairs
    assert similar_pairs(lambda index: photos[4], len(photos), 5) == set()
