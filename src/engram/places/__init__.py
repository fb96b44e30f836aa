"""Vocabulary, Chow-Liu tree, FAB-MAP: an image → the places it may show."""

from __future__ import annotations

from collections.abc import Callable

from engram.places.bag_of_words import BagOfWords
from engram.places.chow_liu import WordStatistics
from engram.places.fabmap import FabMap, FabMapConfig
from engram.places.observation import DetectorModel, ObservationModel
from engram.places.recogniser import Comparison, PlaceRecogniser, ReadsFrames, Recognition
from engram.places.signature import Signatures
from engram.places.training import TrainingConfig, train_vocabulary
from engram.places.tree import TreeArrays
from engram.places.vocabulary import (
    Vocabulary,
    decode_vocabulary,
    default_vocabulary,
    encode_vocabulary,
    hash_of,
    vocabulary_hash,
)

RECOGNISERS: dict[str, Callable[[Vocabulary], PlaceRecogniser]] = {
    FabMap.name: FabMap,
    BagOfWords.name: BagOfWords,
    Signatures.name: Signatures,
}

__all__ = [
    "RECOGNISERS",
    "BagOfWords",
    "Comparison",
    "DetectorModel",
    "FabMap",
    "FabMapConfig",
    "ObservationModel",
    "PlaceRecogniser",
    "ReadsFrames",
    "Recognition",
    "Signatures",
    "TrainingConfig",
    "TreeArrays",
    "Vocabulary",
    "WordStatistics",
    "decode_vocabulary",
    "default_vocabulary",
    "encode_vocabulary",
    "hash_of",
    "train_vocabulary",
    "vocabulary_hash",
]
