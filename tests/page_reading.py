"""Reads what a page carries, by the rules of `tcpipe.report.page` written a second time."""

import base64
import json
import re
import zlib

import numpy as np


def data_of(html):
    """Return the data that the page holds for its script."""
    return json.loads(re.search(r'<script type="application/json" id="page-data">(.*?)</script>', html)[1])


def unpacked(told, name):
    """One column."""
    data = zlib.decompress(base64.b64decode(told["data"]))
    (of,) = [column for column in told["columns"] if column["name"] == name]
    part = data[of["at"] : of["at"] + of["bytes"]]
    if of["kind"] == "text":
        return json.loads(part)
    if of["kind"] in {"u8", "u16", "u32"}:
        return np.frombuffer(part, {"u8": "<u1", "u16": "<u2", "u32": "<u4"}[of["kind"]])
    halves = np.frombuffer(part, "<u2").astype(np.uint32)
    if of["kind"] == "steps":
        return np.where(halves == 65535, np.nan, of["low"] + of["step"] * halves)
    if of["kind"] == "half":
        return (halves << 16).view(np.float32)
    return ((halves[: len(halves) // 2] << 16) | halves[len(halves) // 2 :]).view(np.float32)
