"""Training, keeping and reading vocabularies."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.places.worlds import THINGS, appearances, look, small_vocabulary

from engram.errors import ConfigError, IncompatibleError, InputError, MapCorruptError
from engram.frontend.frame import BRIEF
from engram.places.vocabulary import (
    TrainingConfig,
    decode_vocabulary,
    encode_vocabulary,
    train_vocabulary,
    vocabulary_hash,
)
from engram_lab.teblid import TEBLID

VOCABULARY = small_vocabulary()
BODY = encode_vocabulary(VOCABULARY)


def test_each_thing_becomes_a_word() -> None:
    words = VOCABULARY.quantise(appearances())
    # Random things lie 128 bits apart, noise 10: nearly every word is one thing.
    assert len(set(words.tolist())) >= 0.9 * THINGS


def test_an_image_shows_each_word_once_and_in_order() -> None:
    rng = np.random.default_rng(1)
    words = VOCABULARY.words_of(look(np.array([3, 3, 3, 9]), rng), BRIEF)
    assert np.array_equal(words, np.unique(words))
    assert len(words) <= 4


def test_an_image_without_features_shows_no_words() -> None:
    assert len(VOCABULARY.words_of(np.zeros((0, 32), np.uint8), BRIEF)) == 0


def test_words_of_another_descriptor_are_refused() -> None:
    with pytest.raises(IncompatibleError, match="teblid"):
        VOCABULARY.words_of(np.zeros((1, 32), np.uint8), TEBLID)


def test_training_twice_gives_the_same_bytes() -> None:
    assert encode_vocabulary(small_vocabulary()) == BODY


def test_reading_gives_back_what_was_written() -> None:
    read = decode_vocabulary(BODY)
    assert encode_vocabulary(read) == BODY
    assert read.descriptor == BRIEF
    rng = np.random.default_rng(2)
    image = look(np.arange(20), rng)
    assert np.array_equal(read.quantise(image), VOCABULARY.quantise(image))


def test_the_hash_tells_vocabularies_apart() -> None:
    other = dataclasses.replace(VOCABULARY, trained_on="elsewhere")
    assert vocabulary_hash(BODY) == vocabulary_hash(encode_vocabulary(decode_vocabulary(BODY)))
    assert vocabulary_hash(BODY) != vocabulary_hash(encode_vocabulary(other))


@given(st.data())
def test_damage_is_refused_or_harmless(data) -> None:
    damaged = bytearray(BODY)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        damaged[at] = data.draw(st.integers(0, 255))
    try:
        read = decode_vocabulary(bytes(damaged))
    except (MapCorruptError, IncompatibleError):  # another kind of descriptor, too
        return
    words = read.quantise(appearances())
    assert ((words >= 0) & (words < len(read))).all()


@pytest.mark.parametrize("end", [0, 7, 100, -1])
def test_what_is_cut_off_is_refused(end: int) -> None:
    with pytest.raises(MapCorruptError):
        decode_vocabulary(BODY[:end])


def test_a_ring_of_parents_is_refused() -> None:
    parents = np.full(len(VOCABULARY), -1, np.int32)
    parents[:3] = [1, 2, 0]
    statistics = dataclasses.replace(
        VOCABULARY.statistics, parents=parents, seen_with_parent=np.zeros(len(parents), np.int32)
    )
    ring = encode_vocabulary(dataclasses.replace(VOCABULARY, statistics=statistics))
    with pytest.raises(MapCorruptError, match="cycle"):
        decode_vocabulary(ring)


def test_too_few_descriptors_are_refused() -> None:
    with pytest.raises(InputError, match="too few for 50 words"):
        train_vocabulary([appearances()[:20]], BRIEF, TrainingConfig(words=50))


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="words is 1"):
        TrainingConfig(words=1)
