"""Labels that a caller gives to a request: subject, block, trial, … They are recorded and never interpreted."""

from optodrive.core.errors import InputError

Labels = dict[str, str | int | float | bool]

LABELS_MAX = 32
KEY_MAX = 64
TEXT_MAX = 256
NUMBER_MAX = 2**53
EXPECTED_VALUE = f"text of at most {TEXT_MAX} printable characters, a finite number up to 2^53, true or false"


def parse_labels(value: object, where: str) -> Labels:
    """Return labels of decoded JSON. Raise InputError (bad_label, too_many) beyond their bounds."""
    if not isinstance(value, dict):
        raise InputError(where, value, "an object of labels", code="bad_label")
    if len(value) > LABELS_MAX:
        raise InputError(where, len(value), f"at most {LABELS_MAX} labels", code="too_many")
    for key, item in value.items():
        if not (0 < len(key) <= KEY_MAX and key.isprintable()):
            raise InputError(where, key[:KEY_MAX], f"keys of 1 to {KEY_MAX} printable characters", code="bad_label")
        if not _is_label(item):
            raise InputError(f"{where}.{key}", item, EXPECTED_VALUE, code="bad_label")
    return dict(value)


def _is_label(item: object) -> bool:
    if isinstance(item, str):
        return len(item) <= TEXT_MAX and (item.isprintable() or not item)
    return isinstance(item, bool | int | float) and abs(item) <= NUMBER_MAX  # false for NaN
