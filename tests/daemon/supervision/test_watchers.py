"""Test who may watch the daemon if too many clients want to."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from levid.daemon.host.peer_credentials import Role
from levid.daemon.supervision.request_handlers import Requests


class Reply:
    """What a client got."""

    def __init__(self, role: Role) -> None:
        self.role, self.waiting, self.refused = role, True, ""

    def refuse(self, error: str) -> None:
        self.refused = error


def test_the_oldest_of_the_lowest_role_gives_way() -> None:
    supervisor: Any = SimpleNamespace(post=lambda function: function())
    requests = Requests(supervisor)

    def watch(role: Role) -> Reply:
        reply: Any = Reply(role)
        requests.handlers["watch"]({"every_s": 1.0}, reply)
        return reply

    supervisor.status = None
    flying = [watch(Role.FLY) for _ in range(30)]
    first, second = watch(Role.WATCH), watch(Role.WATCH)
    third = watch(Role.WATCH)
    assert first.refused
    assert not second.refused
    late = [watch(Role.FLY) for _ in range(2)]
    assert second.refused
    assert third.refused
    assert watch(Role.WATCH).refused  # it displaces nobody who may do more
    assert not any(reply.refused for reply in (*flying, *late))
    assert watch(Role.FLY).refused == ""
    assert flying[0].refused
