"""Test the choice of photos that show the same, by features that stand for places around an object."""

import numpy as np
import pytest

from refgs.capture.similar import RANKS, similar_pairs

PLACES = 90  # around the object, with features of their own at two heights
SHOWN = 12  # of them in each photo
EACH = 10  # features of a place at a height


def descriptors(places: np.ndarray, heights: np.ndarray) -> list[np.ndarray]:
    """Make the descriptors of photos that are taken at `places` around an object, as SIFT has them: (M, 128) uint8 for each photo.

    Photos at the two `heights`, 0 and 1, share half of what they show.
    """
    random = np.random.default_rng(0)
    known = random.gamma(0.6, 40, (3, PLACES, EACH, 128))
    photos = []
    for place, height in zip(places, heights, strict=True):
        seen = known[height : height + 2, (place + np.arange(SHOWN)) % PLACES].reshape(-1, 128)
        photos.append((seen + random.normal(0, 8, seen.shape)).clip(0, 255).astype(np.uint8))
    return photos


@pytest.mark.parametrize("order", ["film", "any"])
def test_photos_of_the_same_place_are_paired(order):
    """Check two rounds of a film at two heights, and the same photos in any order: each photo is paired with some of the other round."""
    places, heights = np.tile(np.arange(PLACES), 2), np.repeat([0, 1], PLACES)
    if order == "any":
        shuffled = np.random.default_rng(1).permutation(2 * PLACES)
        places, heights = places[shuffled], heights[shuffled]
    photos = descriptors(places, heights)
    pairs = similar_pairs(photos.__getitem__, len(photos), beside=3)
    assert pairs == similar_pairs(photos.__getitem__, len(photos), beside=3)
    assert all(b - a > 3 for a, b in pairs) and len(pairs) <= len(RANKS) * len(photos)
    a, b = np.array(sorted(pairs)).T
    apart = np.minimum((places[a] - places[b]) % PLACES, (places[b] - places[a]) % PLACES)
    assert (apart < SHOWN).mean() > 0.9
    linked = heights[a] != heights[b]
    assert len({*a[linked], *b[linked]}) > 0.9 * len(photos)


def test_photos_without_features():
    photos = descriptors(np.arange(0, PLACES, 3), np.zeros(PLACES // 3, int))
    photos[4] = photos[9] = photos[4][:0]
    pairs = similar_pairs(photos.__getitem__, len(photos), beside=1)
    assert all(0 <= a < b < len(photos) for a, b in pairs) and (0, 2) in pairs
    assert similar_pairs(lambda index: photos[4], len(photos), beside=1) == set()
