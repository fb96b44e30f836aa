"""Satellite fixes for the live process."""

from __future__ import annotations

import numpy as np


def fix_of(message, stamp_ns: int):
    """A sensor_msgs/NavSatFix by the names of the link; None where the receiver has no fix."""
    at = float(message.latitude), float(message.longitude)
    if message.status.status < 0 or not np.isfinite(at).all():
        return None
    fix = {"stamp_ns": stamp_ns, "latitude_deg": at[0], "longitude_deg": at[1]}
    variance = max(float(message.position_covariance[number]) for number in (0, 4))
    if message.position_covariance_type > 0 and 0 < variance < np.inf:
        fix["sigma_m"] = float(np.sqrt(variance))
    return fix
