"""The server's stream of server-sent events."""

from __future__ import annotations

import json
from http.client import HTTPConnection, HTTPException
from typing import Any, Iterator, NamedTuple, Optional

from .errors import NoServer, RetrogradeError


class Message(NamedTuple):
    """One event of the stream; docs/openapi.json lists them."""

    event: str
    data: Any


class Stream:
    """Iterates over the server's messages until it is closed. A context manager.

    A reader that pauses for some 10 s loses the oldest messages, and receives their number in a message `lost`.
    """

    def __init__(self, connection: HTTPConnection) -> None:
        self._connection: Optional[HTTPConnection] = connection
        self._response = connection.getresponse()
        if self._response.status != 200:
            status = self._response.status
            self.close()
            raise RetrogradeError(f"the stream was answered with status {status}")

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the stream. The machines continue."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._response.close()

    def __iter__(self) -> Iterator[Message]:
        event, data = "", ""
        try:
            for raw in self._response:
                line = raw.decode("utf-8").rstrip("\r\n")
                name, _, value = line.partition(":")
                value = value[1:] if value.startswith(" ") else value
                if not line:
                    if data:
                        yield Message(event, json.loads(data))
                    event, data = "", ""
                elif name == "event":
                    event = value
                elif name == "data":
                    data += value
                # A line that begins with a colon is a keep-alive.
        except (OSError, HTTPException, ValueError) as why:
            if self._connection is None:
                return
            raise NoServer(f"the stream broke off: {why}", "is `retrograde serve` still running?") from None
