"""Removal of secrets from text: known ones in every form, and values that are named as a secret."""

import json
import re
from base64 import b64encode, urlsafe_b64encode
from collections.abc import Iterable
from urllib.parse import quote

REMOVED = "<removed>"
VALUE = r"""("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[^\s"',;&]+)"""
NAMED = re.compile(
    r"""(?i)((?:secret|token|password|passwd|passphrase|api[_-]?key|optodrive-\d+)\\?["']?\s*[=:]\s*)""" + VALUE
)
"""A value behind the name of a secret: in TOML, JSON, an environment, a query or a cookie."""
CREDENTIALS = re.compile(r"(?i)\b((?:bearer[ .]|basic )\s*)[!-~]{8,}")
"""What a header or a subprotocol presents."""


class Redaction:
    """Removes secrets. secrets: those that are known."""

    def __init__(self, secrets: Iterable[str]) -> None:
        forms = {form for secret in secrets for form in _list_forms(secret)}
        self._known = sorted(forms, key=len, reverse=True)  # no form may hide a part of a longer one

    def redact(self, text: str) -> str:
        """Return the text without secrets."""
        for form in self._known:
            text = text.replace(form, REMOVED)
        return CREDENTIALS.sub(rf"\1{REMOVED}", NAMED.sub(rf"\1{REMOVED}", text))


def _list_forms(secret: str) -> list[str]:
    """Return a secret as it stands in text, JSON, an address, and the base64 of a header or a subprotocol."""
    data = secret.encode()
    encoded = (b64encode(data).decode(), urlsafe_b64encode(data).decode())
    return [secret, json.dumps(secret)[1:-1], quote(secret, safe=""), *(text.rstrip("=") for text in encoded)]
