"""CURVE and ZAP: who gets through the learner's port, and what is said to those who do not.

The law: fail closed. A CURVE server without a ZAP handler lets anybody in who knows its public key, unless it has a domain
*and* enforces it; so both are set, and the handler stands before the port is bound. The answer to a request is a pure
function that cannot raise: what it does not understand is refused. ZAP is asked only at the handshake; that a key may still
speak is looked up for every message, by the link.

The door has a thread of its own, for one reason: the learner is away from its sockets for as long as an update or an
evaluation takes, and a handshake that is not answered for two seconds fails, so that whoever joins, or comes back after a
cut, would wait, and would not be told what is wrong. (pyzmq's own authenticator thread ends silently when a callback raises,
knows nothing of files that change, and cannot say who did not speak CURVE at all.) A link that finds its door dead ends the
run: nobody could join any more, and no revocation would be noticed.
"""

from __future__ import annotations

import logging
import os
import struct
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

import zmq

from protocol.errors import UsageError
from protocol.keys.handshake import WATCHED, PendingHandshakes
from protocol.keys.key_folder import Keyring
from protocol.keys.keys import KEY_BYTES, Key, Token
from protocol.log_rate_limiter import LogRateLimiter, suppressed_note

log = logging.getLogger("millrace.door")

DOMAIN = b"millrace"
ZAP = "inproc://zeromq.zap.01"
LOOK_EVERY_S = 1.0  # at the list of clients
AT_ONCE = 100  # requests, or events, before the rest of the door's work gets its turn

Socket = zmq.Socket[bytes]


def serve_with(socket: Socket, key: Key) -> None:
    """Make this socket a CURVE server that asks ZAP about everybody, and refuses everybody while ZAP does not answer."""
    socket.curve_server = True
    socket.curve_secretkey = key.secret
    socket.zap_domain = DOMAIN
    socket.set(zmq.ZAP_ENFORCE_DOMAIN, 1)


def connect_with(socket: Socket, token: Token) -> None:
    """Make this socket a CURVE client that speaks with the holder of the token's server key and nobody else."""
    socket.curve_serverkey = token.server
    socket.curve_publickey = token.client.public
    socket.curve_secretkey = token.client.secret


def answer(request: Sequence[bytes], keyring: Keyring) -> tuple[list[bytes], str]:
    """The reply to a ZAP request (RFC 27, without the envelope), and why it is a refusal, if it is one."""
    number = request[1] if len(request) > 1 else b""
    refused = [b"1.0", number, b"400", b"refused", b"", b""]
    if len(request) != 7 or request[0] != b"1.0":
        return refused, "the question was not understood"
    _, _, domain, _, _, mechanism, key = request
    if domain != DOMAIN or mechanism != b"CURVE" or len(key) != KEY_BYTES:
        return refused, f"expected CURVE, got {mechanism[:20]!r}"
    try:
        why = keyring.why_not_enter(key)
    except Exception as error:  # whatever it is, it is no reason to let somebody in
        why = f"its key cannot be looked up: {error}"
    return ([b"1.0", number, b"200", b"OK", key.hex().encode(), b""], "") if not why else (refused, why)


class AuthenticatorThread(threading.Thread):
    """Stands at a learner's tcp port: answers ZAP if there are keys, counts those who do not get through, and says why."""

    def __init__(self, socket: Socket, keyring: Keyring | None) -> None:
        """`socket`: not yet bound."""
        super().__init__(name="millrace-door", daemon=True)
        context = socket.context
        self.refused = 0
        """handshakes that failed"""
        self.keyring = keyring
        self._lid = LogRateLimiter()
        self._visitors = PendingHandshakes(keys=keyring is not None)
        self._zap: Socket | None = None
        if keyring is not None:
            self._zap = context.socket(zmq.ROUTER)
            self._zap.linger = 0
            try:
                self._zap.bind(ZAP)
            except zmq.ZMQError as error:
                self._zap.close()
                raise UsageError(
                    "a second learner with keys needs a ZeroMQ context of its own: ZAP has one in each"
                ) from error
            serve_with(socket, keyring.key)
        name = f"inproc://millrace-door-{os.urandom(6).hex()}"
        socket.monitor(name, WATCHED)
        self._events: Socket = _pair(context, name, bind=False)
        self._end: Socket = _pair(context, f"{name}-end", bind=True)
        self._ender: Socket = _pair(context, f"{name}-end", bind=False)
        self.start()

    def run(self) -> None:
        """Answer until `close`. Whatever goes wrong with one visitor, the next is answered."""
        try:
            poller = zmq.Poller()
            for one in filter(None, (self._zap, self._events, self._end)):
                poller.register(one, zmq.POLLIN)
            while True:
                ready = dict(poller.poll(int(LOOK_EVERY_S * 1000)))
                if self._end in ready:
                    return
                if self.keyring is not None:
                    self.keyring.refresh()
                try:
                    if self._events in ready:
                        self._look()
                    if self._zap in ready:
                        self._answer()
                except zmq.ContextTerminated:
                    return
                except Exception:
                    log.exception("a visitor could not be dealt with, and was not let in")
        except zmq.ContextTerminated:
            return
        finally:
            if self._zap is not None:
                with suppress(zmq.ZMQError):
                    self._zap.unbind(ZAP)  # now: closing alone frees the name some time later
                self._zap.close()

    def close(self) -> None:
        """Let nobody in any more. The socket's monitor must have been turned off: libzmq waits for one that reads it."""
        with suppress(zmq.ZMQError):  # closed already, or the thread is
            self._ender.send(b"", zmq.NOBLOCK)
        self.join(5.0)
        self._events.close(linger=0)
        self._end.close(linger=0)
        self._ender.close(linger=0)

    def _answer(self) -> None:
        assert self._zap is not None
        assert self.keyring is not None
        for _ in range(AT_ONCE):
            try:
                peer, empty, *request = self._zap.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            except ValueError:
                continue
            reply, why = answer(request, self.keyring)
            host = request[3].decode(errors="replace")[:64] if len(request) > 3 else ""
            if why:
                self._refuse(host, why)
            else:
                self._visitors.approved(host)
            self._zap.send_multipart([peer, empty, *reply])

    def _look(self) -> None:
        for _ in range(AT_ONCE):
            try:
                event, value = struct.unpack("=HI", self._events.recv_multipart(zmq.NOBLOCK)[0])
            except zmq.Again:
                return
            found = self._visitors.saw(event, value)
            if found is not None:
                self._refuse(*found)

    def _refuse(self, host: str, why: str) -> None:
        self.refused += 1
        kept_back = self._lid.due(f"{host} {why}", time.monotonic())
        if kept_back is not None:
            log.warning("%s was not let in: %s%s", host or "somebody", why, suppressed_note(kept_back))


def _pair(context: zmq.Context[Socket], name: str, *, bind: bool) -> Socket:
    socket = context.socket(zmq.PAIR)
    socket.linger = 0
    socket.rcvhwm = 0  # libzmq's own thread would wait where this one does not read
    (socket.bind if bind else socket.connect)(name)
    return socket
