"""FAB-MAP's likelihoods against the published equations, and what they recognise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.places.worlds import look, places, small_vocabulary
from tests.reference.fabmap import log_likelihood

from engram.frontend.frame import BRIEF
from engram.places.recognisers import DetectorModel, FabMap, FabMapConfig

VOCABULARY = small_vocabulary()


def words_of(things: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return VOCABULARY.words_of(look(things, rng), BRIEF)


def by_the_book(config: FabMapConfig, query: np.ndarray, place: np.ndarray) -> float:
    statistics = VOCABULARY.statistics
    parents = statistics.parents
    return log_likelihood(
        set(query.tolist()),
        set(place.tolist()),
        statistics.images,
        statistics.seen.tolist(),
        [-1] * len(parents) if config.naive_bayes else parents.tolist(),
        statistics.seen_with_parent.tolist(),
        config.detector.hit,
        config.detector.false_alarm,
    )


@given(
    st.integers(0, 10_000),
    st.sampled_from([DetectorModel(), DetectorModel(0.8, 0.05), DetectorModel(0.6, 0.0)]),
    st.booleans(),
)
@settings(max_examples=30)
def test_likelihoods_are_those_of_the_published_equations(seed, detector, naive) -> None:
    rng = np.random.default_rng(seed)
    config = FabMapConfig(detector, naive_bayes=naive)
    fabmap = FabMap(VOCABULARY, config)
    shown = [np.unique(rng.integers(0, len(VOCABULARY), n)).astype(np.int32) for n in (0, 5, 40)]
    for words in shown:
        fabmap.add(words)
    for query in shown:
        expected = [by_the_book(config, query, words) for words in shown]
        assert np.abs(fabmap.log_likelihoods(query) - expected).max() < 1e-9


def test_likelihood_elsewhere_is_the_mean_over_the_samples() -> None:
    fabmap = FabMap(VOCABULARY)
    query = VOCABULARY.samples[0][::2].copy()
    each = [by_the_book(fabmap.config, query, sample) for sample in VOCABULARY.samples]
    expected = np.log(np.mean(np.exp(np.array(each) - max(each)))) + max(each)
    assert abs(fabmap._judge(query)[1] - expected) < 1e-9


def test_probabilities_of_all_places_and_of_none_add_up_to_one() -> None:
    rng = np.random.default_rng(5)
    fabmap = FabMap(VOCABULARY)
    for things in places(7, rng):
        fabmap.add(words_of(things, rng))
    found = fabmap.recognise(words_of(np.arange(10), rng), 7)
    assert found.new_place is not None
    assert abs(found.scores.sum() + found.new_place - 1) < 1e-12
    assert (np.diff(found.scores) <= 0).all()


def test_a_place_seen_again_is_found_and_a_new_one_is_not_taken_for_it() -> None:
    rng = np.random.default_rng(6)
    known, unknown = places(200, rng), places(40, rng)
    fabmap = FabMap(VOCABULARY, FabMapConfig(DetectorModel(0.95, 0.05)))  # as this world is
    for things in known:
        fabmap.add(words_of(things, rng))
    again = [fabmap.recognise(words_of(things, rng), 1) for things in known[::5]]
    assert np.mean([one.places[0] == 5 * i for i, one in enumerate(again)]) >= 0.9
    new = [fabmap.recognise(words_of(things, rng), 1) for things in unknown]
    # Twenty samples say little about the best of 200 places, but the two cases lie far apart.
    seen_again = np.median([one.new_place for one in again])
    assert np.median([one.new_place for one in new]) > 1e3 * seen_again


def test_a_place_is_found_at_once_when_it_is_added() -> None:
    rng = np.random.default_rng(7)
    fabmap = FabMap(VOCABULARY)
    for number, things in enumerate(places(30, rng)):
        words = words_of(things, rng)
        assert fabmap.add(words) == number
        assert fabmap.recognise(words, 1).places[0] == number


def test_an_empty_map_is_new_everywhere() -> None:
    found = FabMap(VOCABULARY).recognise(np.array([1, 2], np.int32), 3)
    assert len(found.places) == 0
    assert found.new_place == 1.0


def test_an_image_without_words_is_no_error() -> None:
    fabmap = FabMap(VOCABULARY)
    fabmap.add(np.zeros(0, np.int32))
    fabmap.add(np.array([0, 3], np.int32))
    found = fabmap.recognise(np.zeros(0, np.int32), 5)
    assert sorted(found.places.tolist()) == [0, 1]


@pytest.mark.parametrize("words", [[3, 2], [2, 2], [-1], [10**6]])
def test_words_that_cannot_be_are_refused(words: list[int]) -> None:
    with pytest.raises(ValueError, match="word"):
        FabMap(VOCABULARY).add(np.array(words, np.int32))


def test_evidence_is_what_a_place_gives_beyond_what_it_gives_to_the_samples() -> None:
    rng = np.random.default_rng(3)
    recogniser = FabMap(VOCABULARY)
    for place in places(40, rng):
        recogniser.add(words_of(place, rng))
    query = words_of(places(1, rng)[0], rng)
    usual = np.mean([recogniser.log_likelihoods(one) for one in VOCABULARY.samples], axis=0)
    evidence = recogniser.compare(query).evidence
    # Sums of thousands of terms in another order.
    assert evidence == pytest.approx(recogniser.log_likelihoods(query) - usual, abs=1e-8)
    assert usual.std() > 0.01  # what is taken off differs from place to place
