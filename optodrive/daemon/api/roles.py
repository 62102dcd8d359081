"""The roles of tokens, from the least privileged to the most."""

from typing import Literal, get_args

Role = Literal["viewer", "operator", "armer"]
"""Each role includes those before it. A viewer reads and stops, an operator submits plans, an armer arms."""
PERMISSIONS: dict[Role, str] = {
    "viewer": "reads and stops",
    "operator": "also plays, pauses and dims",
    "armer": "also arms",
}
"""What each role may do besides what those before it may."""
ROLES: tuple[Role, ...] = get_args(Role)


def is_role_sufficient(role: Role, min_role: Role) -> bool:
    """Return whether a role includes the role that a route requires."""
    return ROLES.index(role) >= ROLES.index(min_role)
