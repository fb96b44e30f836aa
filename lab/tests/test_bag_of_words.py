"""The baseline: similarity of sets of words."""

import numpy as np
from tests.places.worlds import small_vocabulary

from engram_lab.bag_of_words import BagOfWords

VOCABULARY = small_vocabulary()


def test_similarity_is_the_cosine_of_idf_vectors() -> None:
    rng = np.random.default_rng(0)
    recogniser = BagOfWords(VOCABULARY)
    statistics = VOCABULARY.statistics
    idf = np.log((statistics.images + 1) / (statistics.seen + 0.5))
    shown = (rng.random((40, len(VOCABULARY))) < 0.3).astype(float)
    for row in shown:
        recogniser.add(np.flatnonzero(row).astype(np.int32))
    query = (rng.random(len(VOCABULARY)) < 0.3).astype(float)
    vectors, asked = shown * idf, query * idf
    cosines = vectors @ asked / np.linalg.norm(vectors, axis=1) / np.linalg.norm(asked)
    found = recogniser.recognise(np.flatnonzero(query).astype(np.int32), 5)
    assert np.allclose(found.scores, np.sort(cosines)[::-1][:5])
    assert np.array_equal(found.places, np.argsort(-cosines, kind="stable")[:5])
    assert found.new_place is None


def test_images_and_places_without_words_are_like_nothing() -> None:
    recogniser = BagOfWords(VOCABULARY)
    recogniser.add(np.zeros(0, np.int32))
    recogniser.add(np.array([1], np.int32))
    assert recogniser.recognise(np.zeros(0, np.int32), 2).scores.tolist() == [0, 0]
    assert recogniser.recognise(np.array([1], np.int32), 2).places.tolist() == [1, 0]
