"""Measures a running bridge: faults that are injected again and again, and minutes of driving.

    measure.py faults PAIRS MAP [--times 50]
    measure.py endure PAIRS MAP --bridge PID [--minutes 10] [--busy 2]

Prints one JSON object. `engram_lab.checks.ros_bridge` prepares images and map, starts the bridge,
and prints this as a table.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import rclpy
from engram_bridge import rigid
from peer import MOUNTED_AT, MOUNTED_XYZW, Driver, Peer, live_process
from std_srvs.srv import SetBool, Trigger

RATE_HZ = 20.0
# A pose counts as wrong if it is further from the truth than both.
WRONG_M, WRONG_SIGMAS = 0.5, 3.0
# A step of odometry counts as a jump if it is so much longer than the longest undisturbed one.
JUMP = 3.0
# A robot that is lost knows its place to no better than this.
SMALL_M = 0.5
HELD_S, LOST_S = 1.5, 30.0


class Faults:
    """Injects faults into a bridge that localises, and waits each time until it does again.

    Args:
        driver: runs the peer.
        town: the map file.
    """

    def __init__(self, driver, town: str) -> None:
        self.driver, self.peer, self.town = driver, driver.peer, town
        self._until_localised()
        self.driver.drive(2 * len(self.peer.pairs["left"]) / RATE_HZ)
        camera_from_base = rigid.inverse(rigid.of_quaternion(MOUNTED_XYZW, MOUNTED_AT))
        # (pairs, 3): where the robot is at each.
        self.expected = (self.peer.pairs["map_from_camera"] @ camera_from_base)[:, :3, 3]
        self.step_m = float(_steps_m(self.peer.odometry).max())

    def run(self, name: str, times: int):
        """The row of a fault: injected so many times."""
        silences_s, unheard_s, recovered_s = [], [], []
        odometry, poses = len(self.peer.odometry), len(self.peer.poses)
        for _ in range(times):
            began = time.monotonic()
            getattr(self, name)()
            mended = time.monotonic()
            self._until_localised()
            recovered_s.append(time.monotonic() - mended)
            heard = [(at, one.header.stamp) for at, one in self.peer.status if at > began - 0.3]
            unheard_s.append(float(np.diff([at for at, _ in heard]).max()))
            said_s = [stamp.sec + 1e-9 * stamp.nanosec for _, stamp in heard]
            silences_s.append(float(np.diff(said_s).max()))
        return {
            "fault": name,
            "times": times,
            "longest_silence_s": max(silences_s),
            "longest_unheard_s": max(unheard_s),
            "wrong_poses": self._wrong(self.peer.poses[poses:]),
            "jumps": self._jumps(self.peer.odometry[max(odometry - 1, 0) :]),
            "median_recovery_s": float(np.median(recovered_s)),
        }

    def killed(self) -> None:
        """The live process is killed."""
        self.driver.until(lambda: live_process(self.town))
        os.kill(live_process(self.town), signal.SIGKILL)

    def map_removed(self) -> None:
        """The map file is gone when the process opens it again."""
        away = self.town + ".away"
        os.replace(self.town, away)
        self.driver.call(Trigger, "engram/save")
        self.driver.until(lambda: "does not exist" in self.peer.status[-1][1].trouble)
        self.driver.drive(HELD_S)
        os.replace(away, self.town)

    def disk_full(self) -> None:
        """No file of the process can grow while it maps and commits."""
        pid = live_process(self.town)
        _, most = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        self.driver.call(SetBool, "engram/map", data=True)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, most))
        self.driver.drive(HELD_S)
        self.driver.call(SetBool, "engram/map", data=False)
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (most, most))

    def unplugged(self) -> None:
        """No image comes, and the robot moves on."""
        self.peer.shows = False
        self.driver.until(lambda: self.peer.status[-1][1].status == "no images")
        self.peer.shows = True

    def clock_back(self) -> None:
        """The camera's clock is set back by a hundred seconds."""
        self.peer.shift_s -= 100.0

    def covered(self) -> None:
        """The lens is covered for half a minute."""
        noise = np.random.default_rng(0)
        shape = self.peer.pairs["left"][0].shape
        self._lost(lambda *_: [noise.integers(4, 7, shape, np.uint8) for _ in range(2)])

    def elsewhere(self) -> None:
        """The camera sees a place that the map does not have, for half a minute."""
        self._lost(lambda left, right: (left[::-1].copy(), right[::-1].copy()))

    def _lost(self, spoils) -> None:
        self.peer.spoils = spoils
        self.driver.until(lambda: self.peer.status[-1][1].status in ("lost", "no_odometry"))
        self.driver.drive(LOST_S)
        self.peer.spoils = None

    def _until_localised(self) -> None:
        before = len(self.peer.poses)

        def localised() -> bool:
            status = self.peer.status[-1][1] if self.peer.status else None
            return len(self.peer.poses) > before + 3 and status.status == "localised"

        self.driver.until(localised, 120.0, "it does not localise")

    def _wrong(self, poses) -> int:
        """Poses that are wrong by more than they say."""
        count = 0
        for number, x, y, z, spread_m in poses:
            error_m = np.linalg.norm(self.expected[self.peer.place(int(number))] - (x, y, z))
            count += error_m > max(WRONG_M, WRONG_SIGMAS * spread_m)
        return int(count)

    def _jumps(self, odometry) -> int:
        return int((_steps_m(odometry) > JUMP * self.step_m).sum())


def _steps_m(odometry):
    """Distance of each step, for each frame that it spans."""
    steps = np.diff(np.array(odometry)[:, :4], axis=0)
    return np.linalg.norm(steps[:, 1:], axis=1) / np.maximum(np.abs(steps[:, 0]), 1)


def _small_while_lost(peer, since: float) -> int:
    """Poses with a small covariance that came while the status was not that of a placed robot."""
    lost = [at for at, one in peer.status if at > since and one.status in ("lost", "no_odometry")]
    if not lost:
        return 0
    first, last = min(lost), max(lost)
    return sum(
        first + 0.5 < at < last - 0.5 and spread_m < SMALL_M
        for at, (*_, spread_m) in zip(peer.posed_at, peer.poses)  # 3.8
    )


def faults(driver, given):
    """All faults, the lost half minutes once each."""
    tested = Faults(driver, given.map)
    rows = [tested.run(name, given.times) for name in given.faults.split(",") if name]
    for name in ("covered", "elsewhere") if given.lost else ():
        began = time.monotonic()
        row = tested.run(name, 1)
        rows.append({**row, "small_covariances": _small_while_lost(driver.peer, began)})
    return {"step_m": tested.step_m, "rows": rows}


def endure(driver, given):
    """Minutes at a rate beside busy loops: drops, ages, and shares of a core."""
    peer = driver.peer
    driver.until(lambda: peer.poses, 60.0)
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(given.busy)]
    try:
        driver.drive(5.0)
        peer.ages_s.clear()
        sent, heard, before = peer.sent, len(peer.odometry), peer.status[-1][1]
        pids = {"bridge": given.bridge, "live": live_process(given.map)}
        began, used = time.monotonic(), {name: _cpu_s(pid) for name, pid in pids.items()}
        driver.drive(60.0 * given.minutes)
        took_s = time.monotonic() - began
        shares = {name: (_cpu_s(pid) - used[name]) / took_s for name, pid in pids.items()}
    finally:
        for one in busy:
            one.kill()
    sent, heard = peer.sent - sent, len(peer.odometry) - heard
    ages_ms = 1e3 * np.array(peer.ages_s)
    statuses = [one.status for _, one in peer.status]
    return {
        "minutes": given.minutes,
        "busy_loops": given.busy,
        "sent": sent,
        "rate_hz": sent / took_s,
        "dropped": sent - heard,
        "dropped_by_process": peer.status[-1][1].dropped - before.dropped,
        "taken": peer.status[-1][1].frames - before.frames,
        "dropped_share": (sent - heard) / sent,
        "age_ms": {str(q): float(np.quantile(ages_ms, q / 100)) for q in (50, 90, 99, 100)},
        "share_of_a_core": shares,
        "localised_share": statuses.count("localised") / len(statuses),
    }


def _cpu_s(pid: int) -> float:
    """CPU time of a process and all its threads."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measures, and prints JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["faults", "endure"])
    parser.add_argument("pairs")
    parser.add_argument("map")
    parser.add_argument("--bridge", type=int)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--faults", default="killed,map_removed,disk_full,unplugged,clock_back")
    parser.add_argument("--lost", action="store_true")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--busy", type=int, default=2)
    given = parser.parse_args()
    rclpy.init()
    peer = Peer(dict(np.load(given.pairs)), RATE_HZ)
    driver = Driver(peer)
    driver.until(lambda: peer.ready, 60.0)
    peer.shows = True
    print(json.dumps(faults(driver, given) if given.what == "faults" else endure(driver, given)))
    peer.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
