"""Test that missing readings at zero force are logged once, and their return."""

from __future__ import annotations

from levid.daemon.supervision.missing_readings_at_rest import StaleMonitor


class World:
    """Simulate periods, some of them with a stale reading."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.now_s, self.cycle, self.stale = 100.0, 0, 0
        self.silence = StaleMonitor(self.said.append)
        self.passes(0.0, 0)

    def passes(self, seconds: float, stale: int, resting: bool = True, rate: int = 1000) -> None:
        self.now_s += seconds
        self.cycle += int(seconds * rate)
        self.stale += stale
        self.silence.poll(self.now_s, self.cycle, self.stale, resting)


def test_silent_electronics_at_rest_are_logged_once_and_so_is_their_return() -> None:
    world = World()
    world.passes(2.0, 2000)
    assert not world.said
    for _ in range(100):
        world.passes(2.0, 2000)
    (line,) = world.said
    assert "missing for 4 s, at zero force: 2000 of the last 2000 periods" in line
    world.passes(2.0, 0)
    assert world.said[1:] == ["readings are back after 202 s"]
    world.passes(2.0, 0)
    assert len(world.said) == 2


def test_intermittent_readings_are_logged_once_a_minute() -> None:
    world = World()
    for _ in range(30):
        for stale in (2000, 2000, 0):
            world.passes(2.0, stale)
    assert sum("missing" in line for line in world.said) == 3
    assert sum("back" in line for line in world.said) == 3


def test_single_stale_readings_flight_and_a_missing_loop_are_not_logged() -> None:
    world = World()
    for _ in range(10):
        world.passes(2.0, 900)
        world.passes(2.0, 2000, resting=False)
        world.passes(2.0, 2000, resting=False)
        world.passes(2.0, 0)
        world.passes(2.0, 0, rate=0)
    assert not world.said
