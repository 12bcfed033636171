"""The handshake: a worker proves that it holds its token's key (CURVE), and the learner looks the key up in its list (ZAP).

A token is never sent. `handshake_failures.py` finds out why a handshake failed.

Rule: fail closed. A CURVE server without a ZAP handler accepts every client that knows its public key, unless the server
sets a domain *and* enforces it. We do both, and start the handler before the port is bound. The answer to a request is a
pure function that cannot raise: it refuses what it does not understand. libzmq asks ZAP only at the handshake, so the link
checks with every message that the sender's key is still allowed.

The authenticator has its own thread, because the learner does not serve its sockets during an update or an evaluation, and
a handshake that is not answered within two seconds fails. Without the thread, a worker that joins or reconnects would have
to wait, and would not be told what is wrong. (pyzmq's own authenticator thread ends silently when a callback raises, does
not notice that files change, and cannot report clients that do not speak CURVE.) If the thread ends, the link ends the run,
because no worker could join any more, and no revocation would be noticed.
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

from millrace.protocol.errors import UsageError
from millrace.protocol.keys.handshake_failures import LEARNER_EVENTS, PendingHandshakes
from millrace.protocol.keys.key_folder import Keyring
from millrace.protocol.keys.keys import KEY_BYTES, Key, Token
from millrace.protocol.logs.log_rate_limiter import LogRateLimiter, suppressed_note

log = logging.getLogger("millrace.authenticator")

DOMAIN = b"millrace"
ZAP = "inproc://zeromq.zap.01"
LIST_CHECK_INTERVAL_S = 1.0  # how often to check whether the file with the list of clients has changed
MAX_BATCH = 100  # at most this many requests, or events, are handled before the other sockets get their turn

Socket = zmq.Socket[bytes]


def serve_with(socket: Socket, key: Key) -> None:
    """Make this socket a CURVE server that asks ZAP about each client, and refuses all clients while ZAP doesn't answer."""
    socket.curve_server = True
    socket.curve_secretkey = key.secret
    socket.zap_domain = DOMAIN
    socket.set(zmq.ZAP_ENFORCE_DOMAIN, 1)


def connect_with(socket: Socket, token: Token) -> None:
    """Make this socket a CURVE client that connects only to the holder of the token's server key."""
    socket.curve_serverkey = token.server
    socket.curve_publickey = token.client.public
    socket.curve_secretkey = token.client.secret


def answer(request: Sequence[bytes], keyring: Keyring) -> tuple[list[bytes], str]:
    """The reply to a ZAP request (RFC 27, without the envelope), and the reason if the reply is a refusal, else ''."""
    number = request[1] if len(request) > 1 else b""
    refused = [b"1.0", number, b"400", b"refused", b"", b""]
    if len(request) != 7 or request[0] != b"1.0":
        return refused, "the request was not understood"
    _, _, domain, _, _, mechanism, key = request
    if domain != DOMAIN or mechanism != b"CURVE" or len(key) != KEY_BYTES:
        return refused, f"expected CURVE, got {mechanism[:20]!r}"
    try:
        why = keyring.rejection_reason(key)
    except Exception as error:  # whatever the error is, the client is refused
        why = f"its key cannot be looked up: {error}"
    return ([b"1.0", number, b"200", b"OK", key.hex().encode(), b""], "") if not why else (refused, why)


class AuthenticatorThread(threading.Thread):
    """Answers ZAP requests if there are keys; counts failed handshakes at a learner's tcp port and logs their reasons."""

    def __init__(self, socket: Socket, keyring: Keyring | None) -> None:
        """Start the thread. `socket` must not be bound yet. Raises `UsageError` if its context has a ZAP handler already."""
        super().__init__(name="millrace-authenticator", daemon=True)
        context = socket.context
        self.refused = 0
        """handshakes that failed"""
        self.keyring = keyring
        self._log_limiter = LogRateLimiter()
        self._pending = PendingHandshakes(keys=keyring is not None)
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
        name = f"inproc://millrace-authenticator-{os.urandom(6).hex()}"
        socket.monitor(name, LEARNER_EVENTS)
        self._events: Socket = _pair(context, name, bind=False)
        self._end_receiver: Socket = _pair(context, f"{name}-end", bind=True)
        self._end_sender: Socket = _pair(context, f"{name}-end", bind=False)
        self.start()

    def run(self) -> None:
        """Answer requests until `close` is called. An error with one client does not affect the next."""
        try:
            poller = zmq.Poller()
            for one in filter(None, (self._zap, self._events, self._end_receiver)):
                poller.register(one, zmq.POLLIN)
            while True:
                ready = dict(poller.poll(int(LIST_CHECK_INTERVAL_S * 1000)))
                if self._end_receiver in ready:
                    return
                if self.keyring is not None:
                    self.keyring.refresh()
                try:
                    if self._events in ready:
                        self._read_events()
                    if self._zap in ready:
                        self._answer()
                except zmq.ContextTerminated:
                    return
                except Exception:
                    log.exception("a client caused an error, and was not let in")
        except zmq.ContextTerminated:
            return
        finally:
            if self._zap is not None:
                with suppress(zmq.ZMQError):
                    self._zap.unbind(ZAP)  # frees the name immediately; closing alone frees it some time later
                self._zap.close()

    def close(self) -> None:
        """Stop the thread. Disable the socket's monitor first, because libzmq blocks while nobody reads its events."""
        with suppress(zmq.ZMQError):  # it is closed already, or the thread has ended
            self._end_sender.send(b"", zmq.NOBLOCK)
        self.join(5.0)
        self._events.close(linger=0)
        self._end_receiver.close(linger=0)
        self._end_sender.close(linger=0)

    def _answer(self) -> None:
        assert self._zap is not None
        assert self.keyring is not None
        for _ in range(MAX_BATCH):
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
                self._pending.add_approved(host)
            self._zap.send_multipart([peer, empty, *reply])

    def _read_events(self) -> None:
        for _ in range(MAX_BATCH):
            try:
                event, value = struct.unpack("=HI", self._events.recv_multipart(zmq.NOBLOCK)[0])
            except zmq.Again:
                return
            failure = self._pending.handle_event(event, value)
            if failure is not None:
                self._refuse(*failure)

    def _refuse(self, host: str, why: str) -> None:
        self.refused += 1
        kept_back = self._log_limiter.due(f"{host} {why}", time.monotonic())
        if kept_back is not None:
            log.warning("%s was not let in: %s%s", host or "somebody", why, suppressed_note(kept_back))


def _pair(context: zmq.Context[Socket], name: str, *, bind: bool) -> Socket:
    socket = context.socket(zmq.PAIR)
    socket.linger = 0
    socket.rcvhwm = 0  # no limit: libzmq's own thread would block while this one does not read
    (socket.bind if bind else socket.connect)(name)
    return socket
