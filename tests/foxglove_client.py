"""A client of the Foxglove WebSocket protocol that shares no code with the server.

The protocol: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

from __future__ import annotations

import json
import socket
import struct
import time
from contextlib import ExitStack
from types import TracebackType
from typing import Any, NamedTuple, Self

from websockets.sync.client import connect
from websockets.typing import Subprotocol

_ANSWER_S = 30.0
_MESSAGE_DATA = 1


class Message(NamedTuple):
    """One message: its log time in ns and its bytes."""

    time_ns: int
    data: bytes


class FoxgloveClient:
    """Connect, know the channels by topic, and collect messages of subscribed topics."""

    def __init__(self, port: int, origin: str | None = None) -> None:
        self._stack = ExitStack()
        self._connection = self._stack.enter_context(
            connect(
                f"ws://127.0.0.1:{port}",
                subprotocols=[Subprotocol("foxglove.sdk.v1")],
                origin=origin,  # type: ignore[arg-type]
                compression=None,
                max_size=None,
            )
        )
        self.info: dict[str, Any] = json.loads(self._connection.recv(_ANSWER_S))
        assert self.info["op"] == "serverInfo"
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}
        self.messages: dict[str, list[Message]] = {}
        while not self.channels:
            self._handle(self._connection.recv(_ANSWER_S))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def abort(self) -> None:
        """Disconnect without a farewell, which would wait until all is read."""
        self._connection.socket.shutdown(socket.SHUT_RDWR)

    def subscribe(self, *topics: str) -> None:
        wanted = []
        for topic in topics:
            number = len(self._topics) + 1
            self._topics[number] = topic
            self.messages[topic] = []
            wanted.append({"id": number, "channelId": self.channels[topic]["id"]})
        self._connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def collect(self, seconds: float) -> None:
        """Collect what comes within this time."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0.0:
            try:
                self._handle(self._connection.recv(left_s))
            except TimeoutError:
                return

    def until(self, topic: str, count: int) -> list[Message]:
        """Collect until a topic has this many messages."""
        while len(self.messages[topic]) < count:
            self._handle(self._connection.recv(_ANSWER_S))
        return self.messages[topic]

    def _handle(self, message: str | bytes) -> None:
        if isinstance(message, str):
            content = json.loads(message)
            if content["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in content["channels"]}
            return
        if message[0] == _MESSAGE_DATA:
            number, time_ns = struct.unpack_from("<IQ", message, 1)
            self.messages[self._topics[number]].append(Message(time_ns, message[13:]))
