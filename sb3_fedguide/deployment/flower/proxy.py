"""The proxy before Flower's SuperLink: from outside, clients reach only the paths that they need.

The SuperLink has one port for everything. Only paths below ``/v1/fleet/`` require a registered key; a client that reaches
other paths can register keys and start code on the server. So the SuperLink listens on the loopback device, and this proxy
answers 403 to everything but the fleet's paths. It terminates TLS, since encrypted requests cannot be filtered.
"""

from __future__ import annotations

import re
import socket
import ssl
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, MutableMapping
from pathlib import Path
from typing import Any

import httpx
import uvicorn

#: Flower sends chunks of up to 5 MB.
MAX_BODY = 8 * 2**20
_FLEET = re.compile(rb"/v1/fleet/[a-z-]+")
#: Headers of one connection, and those by which a proxy would be believed.
_OWN = re.compile(rb"connection|keep-alive|transfer-encoding|te|trailer|upgrade|host|content-length|accept-encoding|forwarded|"
                  rb"x-forwarded-.*|proxy-.*")  # fmt: skip

Event = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Event]]
Send = Callable[[Event], Awaitable[None]]


class FleetProxy:
    """An ASGI application that passes the fleet's requests on.

    :param upstream: where the SuperLink listens, such as ``https://127.0.0.1:8000``
    :param ca: file of the authority that signed its certificate
    """

    def __init__(self, upstream: str, ca: Path) -> None:
        self._upstream = upstream
        self._client = httpx.AsyncClient(
            verify=ssl.create_default_context(cafile=ca), timeout=60.0, trust_env=False, follow_redirects=False
        )

    async def __call__(self, scope: Event, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # no WebSockets
            return
        path: bytes = scope["raw_path"]  # as it was sent: nothing is decoded between this check and the SuperLink
        if scope["method"] != "POST" or scope["query_string"] or not _FLEET.fullmatch(path):
            await _answer(send, 403, b"only the paths of registered clients are open here\n")
            return
        try:
            body = b"".join([part async for part in _body(receive)])
            headers = [*_passed(scope["headers"]), (b"accept-encoding", b"identity")]
            reply = await self._client.post(self._upstream + path.decode(), content=body, headers=headers)
        except _DisconnectedError:
            return
        except _TooLargeError:
            await _answer(send, 413, b"a request is larger than Flower's chunks are\n")
        except httpx.HTTPError:
            await _answer(send, 502, b"the SuperLink does not answer\n")
        else:
            await _answer(send, reply.status_code, reply.content, _passed(reply.headers.raw))


def _passed(headers: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
    return [(name.lower(), value) for name, value in headers if not _OWN.fullmatch(name.lower())]


class _TooLargeError(Exception):
    pass


class _DisconnectedError(Exception):
    pass


async def _body(receive: Receive) -> AsyncIterator[bytes]:
    size = 0
    while True:
        event = await receive()
        if event["type"] == "http.disconnect":
            raise _DisconnectedError
        part = event.get("body", b"")
        size += len(part)
        if size > MAX_BODY:
            raise _TooLargeError
        yield part
        if not event.get("more_body", False):
            return


async def _answer(send: Send, status: int, body: bytes, headers: list[tuple[bytes, bytes]] | None = None) -> None:
    length = (b"content-length", str(len(body)).encode())
    await send({"type": "http.response.start", "status": status, "headers": [*(headers or []), length]})
    await send({"type": "http.response.body", "body": body})


class ProxyServer:
    """Runs a :class:`FleetProxy` behind TLS in a thread, as a context manager.

    :param address: ``(host, port)`` to listen on
    :param certificate: file of the server's certificate, and ``key`` of its key
    :param n_clients: number of clients, for the limit on connections
    :raises OSError: if it cannot listen on the address
    """

    def __init__(self, address: tuple[str, int], proxy: FleetProxy, certificate: Path, key: Path, n_clients: int) -> None:
        config = uvicorn.Config(
            proxy, ssl_certfile=certificate, ssl_keyfile=key, log_level="warning", access_log=False, lifespan="off",
            ws="none", http="h11", server_header=False, limit_concurrency=64 + 16 * n_clients,
        )  # fmt: skip
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._socket = socket.create_server(address, family=family)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="proxy", daemon=True)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def __enter__(self) -> ProxyServer:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._server.should_exit = True
        self._thread.join(timeout=5.0)
        self._socket.close()
