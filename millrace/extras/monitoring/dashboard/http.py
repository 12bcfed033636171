"""The part of HTTP that the dashboard needs: a request in, an answer out. Pure.

Rule: a request is refused unless its method, its Host and the token at the beginning of its path are right. A wrong token is
    answered like a wrong path, so that an answer doesn't help to guess the token. Every answer forbids the browser
    everything that its page doesn't need.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import NamedTuple
from urllib.parse import parse_qs, unquote, urlsplit

CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "media-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors http://localhost:* http://127.0.0.1:* vscode-webview:"  # notebooks show the page in a cell
)
HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Connection": "close",
}
REASONS = {
    200: "OK",
    206: "Partial Content",
    304: "Not Modified",
    400: "Bad Request",
    404: "Not Found",
    405: "Method Not Allowed",
    416: "Range Not Satisfiable",
    421: "Misdirected Request",
    500: "Internal Server Error",
}
MOST_FIELDS = 100  # largest number of fields in a query
PART_BYTES = 1 << 18
RANGE = re.compile(r"bytes=([0-9]{0,15})-([0-9]{0,15})")  # a single part; if several are requested, the whole body is sent


class PageRequest(NamedTuple):
    """A browser's request."""

    method: str
    path: tuple[str, ...]
    """the parts of the path; the first one is the token"""
    query: Mapping[str, list[str]]
    headers: Mapping[str, str]
    """the headers, by lowercase name"""


class StoredBody(NamedTuple):
    """The body of an answer that is stored in a file. Only the requested part is read."""

    tag: str
    """entity tag: it differs if the content differs"""
    size: int
    """number of bytes"""
    read: Callable[[int, int], bytes]
    """reads the bytes from one offset up to another"""


class PageAnswer(NamedTuple):
    """The answer to a browser."""

    body: bytes | StoredBody
    content_type: str = "text/html; charset=utf-8"
    status: int = 200


def refusal(status: int) -> PageAnswer:
    """An answer whose text is only the status."""
    return PageAnswer(f"{status} {REASONS[status]}\n".encode(), "text/plain; charset=utf-8", status)


def parsed(head: bytes) -> PageRequest | None:
    """The request in the head of an HTTP message; None if the head isn't valid."""
    first, *lines = head.decode("latin-1").split("\r\n")
    method, _, rest = first.partition(" ")
    target, _, version = rest.partition(" ")
    fields = [line.partition(":") for line in lines if line]
    if not (
        method and target.startswith("/") and version in ("HTTP/1.1", "HTTP/1.0") and all(colon for _, colon, _ in fields)
    ):
        return None
    headers = {name.lower(): value.strip() for name, _, value in fields}
    if len(headers) < len(fields) and sum(name.lower() == "host" for name, _, _ in fields) > 1:
        return None
    try:
        url = urlsplit(f"http://x{target}")
        query = parse_qs(url.query, max_num_fields=MOST_FIELDS)
    except ValueError:
        return None
    return PageRequest(method, tuple(unquote(part) for part in url.path.split("/")[1:]), query, headers)


def why_refused(request: PageRequest | None, token: str, hosts: Collection[str]) -> int:
    """The status with which a request is refused; 0 if it is accepted. `hosts`: allowed values of Host; empty: any."""
    if request is None:
        return 400
    if hosts and request.headers.get("host", "").lower() not in hosts:
        return 421  # DNS rebinding: the name of another site points here
    if request.method not in ("GET", "HEAD"):
        return 405
    return 0 if hmac.compare_digest(request.path[0].encode(), token.encode()) else 404


def answer_parts(request: PageRequest | None, answer: PageAnswer) -> Iterator[bytes]:
    """The bytes of an answer, in the parts in which they are sent.

    The first part contains the head. A body is read part by part while it is sent. If the browser already has the same
    content, or requested only the head, the answer has no body.
    """
    headers = dict(HEADERS)
    whole = _stored(answer.body)
    status = answer.status
    part = range(whole.size)
    if request is not None and status == 200:
        headers["ETag"] = tag = f'"{whole.tag}"'
        if request.headers.get("if-none-match") == tag:
            status = 304
        elif request.method == "GET" and (wanted := _wanted_part(request.headers, tag, whole.size)) is not None:
            status = 206 if wanted else 416  # 206: for example, a video played from the middle
            part = wanted
            headers["Content-Range"] = f"bytes {f'{part.start}-{part.stop - 1}' if part else '*'}/{whole.size}"
    if status == 405:
        headers["Allow"] = "GET, HEAD"
    if status != 304:
        headers |= {"Content-Type": answer.content_type, "Content-Length": str(len(part))}
    has_body = status != 304 and not (request is not None and request.method == "HEAD")
    lines = [f"HTTP/1.1 {status} {REASONS[status]}", *(f"{name}: {value}" for name, value in headers.items()), "", ""]
    first = "\r\n".join(lines).encode()
    end = part.stop if has_body else part.start
    yield first + whole.read(part.start, min(part.start + PART_BYTES, end))
    for begin in range(part.start + PART_BYTES, end, PART_BYTES):
        yield whole.read(begin, min(begin + PART_BYTES, end))


def _stored(body: bytes | StoredBody) -> StoredBody:
    if isinstance(body, StoredBody):
        return body
    return StoredBody(hashlib.blake2b(body, digest_size=16).hexdigest(), len(body), lambda begin, end: body[begin:end])


def _wanted_part(headers: Mapping[str, str], tag: str, size: int) -> range | None:
    """The range of bytes that the browser requests; empty if it doesn't exist; None for all bytes (RFC 9110, section 14)."""
    match = RANGE.fullmatch(headers.get("range", ""))
    if match is None or not any(match.groups()) or headers.get("if-range", tag) != tag:
        return None
    first, last = match.groups()
    if not first:
        return range(max(0, size - int(last)), size)
    if last and int(last) < int(first):
        return None
    return range(min(int(first), size), min(int(last) + 1, size) if last else size)
