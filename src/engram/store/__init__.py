"""A map on disk: revisions, transactions, integrity; and the bytes that stand for a frame."""

from engram.store.blob import decode_landmarks, decode_thumbnail, encode_landmarks, encode_thumbnail

__all__ = ["decode_landmarks", "decode_thumbnail", "encode_landmarks", "encode_thumbnail"]
