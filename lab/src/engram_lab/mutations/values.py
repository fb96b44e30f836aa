"""Values that are wrong, extreme or too large, by type."""

from __future__ import annotations

import json
import random
from typing import Any

import cv2
import msgspec
import numpy as np

_INTS = (0, 1, -1, 2, 127, 255, 65_535, 65_536, 2**31, -(2**31), 2**40, 2**62, 2**63 - 1, -(2**63))
_FLOATS = (0.0, -0.0, -1.0, 1e-320, 1e300, -1e300, float("inf"), float("-inf"))
_DEEP = 100_000


def integer(value: int, chance: random.Random) -> int:
    """Another number of 64 bits."""
    near = value + chance.choice([-1, 1, 256])
    return chance.choice([*_INTS, near if abs(near) < 2**62 else 0])


def real(value: float, chance: random.Random) -> float:
    """Another number, infinities included; SQLite keeps no NaN."""
    return chance.choice([*_FLOATS, value * 2, value + 1e-9])


def text(value: str, chance: random.Random) -> str:
    """Another text: empty, long, with control characters, or bad JSON."""
    wild = "\x1b]0;owned\x07\x1b[2J\u202e\r\n"
    made = [
        "",
        wild,
        value + wild,
        value[:-1],
        "x" * 1_000_000,
        "1" * 10_000,
        "[" * _DEEP,
        '{"a":' * _DEEP,
        '{"a": 1e999, "b": NaN}',
        '{"a": ' + "9" * 5_000 + "}",
        '{"a": ' + "[" * 900 + "]" * 900 + "}",
        '{"a": null, "merge": [], "nodes": "many", "frames": -1}',
        "null",
        '"\\ud800"',
        "\u0000",
        "../../etc/passwd",
    ]
    if value.startswith("{") and chance.random() < 0.5:
        return bent_json(value, chance)
    return chance.choice(made)


def bent_json(value: str, chance: random.Random) -> str:
    """The object with one value of another kind, anywhere in it."""
    content = json.loads(value)
    holders = [content]
    for one in holders:
        inner = one.values() if isinstance(one, dict) else one
        holders += [some for some in inner if isinstance(some, dict | list) and some]
    holder = chance.choice(holders)
    if not holder:
        return '{"merge": 1}'
    key = chance.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key] = chance.choice([None, -1, 2**70, 1e300, "x", [], {}, [[]], {"a": {}}, True])
    return json.dumps(content)


def blob(value: bytes, chance: random.Random) -> bytes:
    """Other bytes: flipped, cut, grown, not finite, or a large run."""
    match chance.randrange(7):
        case 0:
            return b""
        case 1:
            return value[: chance.randrange(len(value) + 1)]
        case 2:
            return value + chance.randbytes(chance.randint(1, 64))
        case 3:
            return np.full(len(value) // 8, chance.choice([np.nan, np.inf, 1e300])).tobytes()
        case 4 if chance.random() < 0.05:
            return bytes(64 * 2**20)
        case _:
            return flipped(value, chance)


def flipped(value: bytes, chance: random.Random) -> bytes:
    """A few bits changed."""
    if not value:
        return b"\0"
    body = bytearray(value)
    for _ in range(chance.choice([1, 1, 2, 8])):
        body[chance.randrange(len(body))] ^= 1 << chance.randrange(8)
    return bytes(body)


def landmarks(body: bytes, chance: random.Random) -> bytes:
    """A safetensors file whose header or arrays are wrong."""
    length = int.from_bytes(body[:8], "little")
    header, arrays = body[8 : 8 + length], body[8 + length :]
    match chance.randrange(6):
        case 0:
            header = flipped(header, chance)
        case 1:
            header = _bent_header(header.decode(), chance).encode()
        case 2:
            header = chance.choice([b"[" * _DEEP, b'{"a":' * _DEEP, b"{}", b""])
        case 3:
            arrays = flipped(arrays, chance)
        case 4:
            arrays = bytes(len(arrays))
        case _:
            length = chance.choice([0, 2**31, 2**63, 2**64 - 1, length + 1])
            return length.to_bytes(8, "little") + header + arrays
    return len(header).to_bytes(8, "little") + header + arrays


def _bent_header(header: str, chance: random.Random) -> str:
    """The header with a wrong value in it, or in the JSON that its own metadata hold."""
    about = json.loads(header).get("__metadata__", {})
    within = [key for key, value in about.items() if value.startswith("{")]
    if not within or chance.random() < 0.3:
        return bent_json(header, chance)
    about[within[0]] = bent_json(about[within[0]], chance)
    return json.dumps(json.loads(header) | {"__metadata__": about})


def picture(value: bytes, chance: random.Random) -> bytes:
    """A JPEG whose size is a lie, whose body is wrong, or another format."""
    body = bytearray(value)
    match chance.randrange(5):
        case 0:
            at = body.index(b"\xff\xc0")
            sides = chance.choice([(1024, 1024), (65_535, 65_535), (0, 0), (1, 1024)])
            body[at + 5 : at + 9] = b"".join(side.to_bytes(2, "big") for side in sides)
        case 1:
            second = b"\xff\xc0\x00\x0b\x08\xff\xff\xff\xff\x01\x01\x11\x00"
            at = chance.choice([2, body.index(b"\xff\xda")])
            body[at:at] = second
        case 2:
            return cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
        case 3:
            return bytes(body[:2]) + b"\xff\xe1\x00\x00" * chance.choice([1, 50_000])
        case _:
            return flipped(value, chance)
    return bytes(body)


def packed_attempts(value: bytes, chance: random.Random) -> bytes:
    """MessagePack of attempts with other contents, or depth, or promised lengths."""
    content: dict[str, Any] = msgspec.msgpack.decode(value)
    match chance.randrange(6):
        case 0:
            content["base"] = chance.choice([2**61, -(2**61), 2**62, 2**63 - 1])
        case 1:
            content["policies"] = chance.choice([[], ["\x1b[31m"], ["x"] * 100_000])
        case 2:
            content["nodes"] = blob(content["nodes"], chance)
        case 3:
            content["rows"] = blob(content["rows"], chance)
        case 4:
            return chance.choice(
                [b"\x91" * _DEEP, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff"]
            )
        case _:
            return flipped(value, chance)
    return msgspec.msgpack.encode(content)
