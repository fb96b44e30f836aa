"""Header of a frame log, and its JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from engram.errors import EngramError, IncompatibleError, MapCorruptError
from engram.frontend import DescriptorKind, feature_kind
from engram.geometry import SE3, StereoCamera
from engram.graph.clock import check_longitude, is_zone_name
from engram.graph.model import Clock
from engram.sequences.sequence import SequenceInfo

_CAMERA_NUMBERS = ("fx", "fy", "cx", "cy", "baseline_m")
_CAMERA_SIZES = ("width", "height")


@dataclass(frozen=True, slots=True)
class FrameLogHeader:
    """Facts common to all frames of a log.

    Attributes:
        info: facts of the drive; `format` names the layout of its images.
        camera: the camera of all frames.
        descriptor: the kind of all descriptors.
        frontend: hash of the front-end's version and configuration.
        odometry: hash of the odometry's version and configuration.
        frames: which frames of the source were recorded, `str` of a `FrameRange`.
    """

    info: SequenceInfo
    camera: StereoCamera
    descriptor: DescriptorKind
    frontend: str
    odometry: str = ""
    frames: str = ""

    def to_json(self) -> str:
        """Canonical: equal headers give equal text."""
        camera = self.camera
        values = {
            "name": self.info.name,
            "source_format": self.info.format,
            "clock": self.info.clock.value,
            "robot": self.info.robot,
            "longitude_deg": self.info.longitude_deg,
            "zone": self.info.zone,
            "descriptor": self.descriptor,
            "frontend": self.frontend,
            "odometry": self.odometry,
            "frames": self.frames,
            "camera": {
                **{name: float(getattr(camera, name)) for name in _CAMERA_NUMBERS},
                **{name: int(getattr(camera, name)) for name in _CAMERA_SIZES},
                "rectification": camera.rectification,
                "cam_from_rig": (
                    None
                    if camera.cam_from_rig is None
                    else camera.cam_from_rig.matrix()[:3].ravel().tolist()
                ),
                "id": camera.id,
            },
        }
        return json.dumps(values, sort_keys=True)

    @staticmethod
    def from_json(text: str) -> FrameLogHeader:
        """Undo `to_json`.

        Raises:
            MapCorruptError: the text is not a valid header.
            IncompatibleError: its kind of descriptor is unknown here.
        """
        try:
            values = json.loads(text)
            camera = _camera(values["camera"])
            info = SequenceInfo(
                _text(values["name"]),
                _text(values["source_format"]),
                Clock(values["clock"]),
                None if values["robot"] is None else _text(values["robot"]),
                None if values["longitude_deg"] is None else float(values["longitude_deg"]),
                None if values["zone"] is None else _text(values["zone"]),
            )
            check_longitude(info.longitude_deg)
            if info.zone is not None and not is_zone_name(info.zone):
                raise ValueError(f"{info.zone!r:.40} is not a time zone")
            return FrameLogHeader(
                info,
                camera,
                feature_kind(_text(values["descriptor"])).name,
                _text(values["frontend"]),
                _text(values["odometry"]),
                _text(values["frames"]),
            )
        except IncompatibleError:
            raise
        except (ValueError, KeyError, TypeError, RecursionError, EngramError) as error:
            raise MapCorruptError(f"the frame log's header cannot be read: {error}") from error


def _camera(values: dict[str, Any]) -> StereoCamera:
    mounting = values["cam_from_rig"]
    # Not projected onto SO(3) again: the last bits count for the camera's id.
    matrix = None if mounting is None else np.array(mounting, dtype=np.float64).reshape(3, 4)
    camera = StereoCamera(
        **{name: float(values[name]) for name in _CAMERA_NUMBERS},
        width=int(values["width"]),
        height=int(values["height"]),
        cam_from_rig=None if matrix is None else SE3(matrix[:, :3].copy(), matrix[:, 3].copy()),
        rectification=_text(values["rectification"]),
    )
    if camera.id != values["id"]:
        raise ValueError(f"camera {values['id']} does not match its values")
    return camera


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value
