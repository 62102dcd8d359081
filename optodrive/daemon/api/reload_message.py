"""The supervisor's message that a reload has changed tokens or settings, as the processes apply it that use them."""

from typing import Any

from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.device.config_sections import DaemonSection


def apply_reload(
    policy: AccessPolicy, daemon: DaemonSection, fields: dict[str, Any]
) -> tuple[DaemonSection, tuple[Token, ...]]:
    """Apply a reload to the policy. Return the changed settings and the revoked tokens. fields: of the message."""
    daemon = daemon.model_copy(update=fields["daemon"] | {"hosts": tuple(fields["daemon"]["hosts"])})
    return daemon, policy.update(Tokens(Token(*entry) for entry in fields["tokens"]), daemon)
