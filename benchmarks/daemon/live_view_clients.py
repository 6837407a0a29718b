"""Clients of a live view for `live_view_cost.py`: they read all that comes, and one reads nothing.

The argument is JSON: `port` of the stream, `page_port` of the page or null, number of `clients`.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import struct
import sys

_HANDSHAKE = (
    "GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)
_LENGTH = 500
_TOPICS = ("/levid/cycle", "/levid/cycle_min", "/levid/cycle_max")


def main() -> None:
    settings = json.loads(sys.argv[1])
    os.nice(19)
    selector = selectors.DefaultSelector()
    ends = [_subscribed(settings["port"]) for _ in range(settings["clients"])]
    if settings["page_port"]:
        page = socket.create_connection(("127.0.0.1", settings["page_port"]))
        page.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        ends.append(page)
    for end in ends[1:] or ends:  # of several, the first one reads nothing
        selector.register(end, selectors.EVENT_READ)
    while True:
        for key, _ in selector.select():
            if not key.fileobj.recv(1 << 20):  # type: ignore[union-attr]
                return


def _subscribed(port: int) -> socket.socket:
    """Return a connection that has subscribed to the decimated rows."""
    end = socket.create_connection(("127.0.0.1", port))
    end.sendall(_HANDSHAKE.encode())
    seen = b""
    while b'"advertise"' not in seen or b'"/levid/events"' not in seen:
        seen += end.recv(1 << 20)
    text = seen[seen.index(b'{"op":"advertise"') :]
    channels = json.JSONDecoder().raw_decode(text.decode(errors="replace"))[0]["channels"]
    ids = [channel["id"] for channel in channels if channel["topic"] in _TOPICS]
    subscriptions = [{"id": number, "channelId": number} for number in ids]
    message = json.dumps({"op": "subscribe", "subscriptions": subscriptions})
    end.sendall(_frame(message.ljust(_LENGTH).encode()))
    return end


def _frame(text: bytes) -> bytes:
    """Return a text frame of _LENGTH bytes with the mask 0, which leaves the text as it is."""
    return struct.pack(">BBH", 0x81, 0x80 | 126, len(text)) + bytes(4) + text


if __name__ == "__main__":
    main()
