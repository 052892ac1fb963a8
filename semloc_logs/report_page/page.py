"""The page as one file: markup, style, scripts, data and pictures; nothing is loaded."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import semloc_logs

SCRIPTS = (  # in the order of their definitions
    "dom.js",
    "data.js",
    "state.js",
    "colours.js",
    "sheets.js",
    "map.js",
    "details.js",
    "filters.js",
    "matrix.js",
    "tables.js",
    "main.js",
)
SLOT = re.compile(r"\{\{(\w+)\}\}")


def page(content: Mapping[str, Any], pictures: Mapping[str, str]) -> str:
    """HTML of the data ``content``; ``pictures`` are WebP in base64 by the id of their element.

    The policy of the page forbids every connection and every script but its own; names from logs
    are data or escaped text.
    """
    style = _asset("page.css")
    script = '"use strict";\n' + "\n".join(_asset(name) for name in SCRIPTS)
    names = ", ".join(str(session["name"]) for session in content["sessions"])
    workspace = str(content["workspace"])
    slots = {
        "policy": _policy(script, style),
        "title": html.escape(f"Loop closures of {workspace}"),
        "workspace": html.escape(workspace),
        "sessions": html.escape(names),
        "generator": html.escape(f"Written by semloc {semloc_logs.__version__}"),
        "style": style,
        "script": script,
        "data": script_json(content),
        "pictures": "\n".join(
            f'<script type="text/plain" id="{html.escape(name)}">{data}</script>'
            for name, data in pictures.items()
        ),
    }
    # in one pass: what a slot holds is not searched for slots
    return SLOT.sub(lambda slot: slots[slot[1]], _asset("page.html"))


def script_json(content: object) -> str:
    """JSON that cannot end the script element that holds it."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _policy(script: str, style: str) -> str:
    """The content security policy: no connection, and the page's own script and style only."""
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {_digest(script)}",
            f"style-src {_digest(style)}",
            "img-src data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _asset(name: str) -> str:
    return files("semloc_logs.report_page").joinpath("assets", name).read_text(encoding="utf-8")
