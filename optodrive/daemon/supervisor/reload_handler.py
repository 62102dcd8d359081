"""A reload that a service manager or a caller requests: its application by the web process, and the answer."""

from typing import Any

from optodrive.core.errors import OptodriveError, escape_unprintable
from optodrive.daemon.api.reload_requests import REQUEST, RESULT
from optodrive.daemon.log import DaemonLog
from optodrive.daemon.notify import Notifier
from optodrive.daemon.reload import ConfigReloader, ReloadResult
from optodrive.daemon.responses.problem import build_error_problem
from optodrive.daemon.responses.state import ReloadReport
from optodrive.daemon.supervisor.supervisor import Supervisor


class ReloadHandler:
    """Handles one reload after the other."""

    def __init__(self, reloader: ConfigReloader, supervisor: Supervisor, notifier: Notifier, log: DaemonLog) -> None:
        self._reloader = reloader
        self._supervisor = supervisor
        self._notifier = notifier
        self._log = log
        self._number = 0
        self._applied: ReloadResult | None = None
        self._callers: list[str] = []

    def request(self) -> None:
        """Read the configuration and send the changes to the web process."""
        self._notifier.notify_reloading()
        try:
            result = self._reloader.reload(self._supervisor.link_view.board_state)
        except OptodriveError as error:
            self._refuse(error)
            return
        except Exception as error:  # of no file that was foreseen: this process must go on, for it watches the others
            self._refuse(OptodriveError(escape_unprintable(f"{type(error).__name__}: {error}")))
            return
        self._number += 1
        self._applied = result
        if not self._supervisor.send_reload(result.build_web_message(self._number)):
            # The web process gets it when it starts; a caller who has lost the right may have armed the board.
            if result.revoked:
                self._supervisor.link_view.stop()
            self._finish(result)

    def _refuse(self, error: OptodriveError) -> None:
        self._log.write(f"not reloaded, nothing changed: {error}", "err", EVENT="reload-refused")
        self._supervisor.record_audit({"event": "reload_refused", "reason": str(error)})
        self._notifier.send("READY=1", f"STATUS=not reloaded: {error}")
        self._answer({"problem": build_error_problem(error).to_dict()})

    def on_web_message(self, fields: dict[str, Any]) -> None:
        """Begin the reload that a caller requests. End one when the web process has applied it."""
        if fields.get("kind") == REQUEST:
            self._callers.append(fields["id"])
            self.request()
        elif fields.get("kind") == "reloaded" and fields.get("id") == self._number and self._applied is not None:
            self._finish(self._applied)

    def _finish(self, result: ReloadResult) -> None:
        self._applied = None
        self._log.write(result.line, "notice", EVENT="reloaded")
        self._notifier.send("READY=1", f"STATUS={result.line}")
        revoked = [token.name for token in result.revoked]
        report = ReloadReport(message=result.line, applied=result.reloaded, waiting=result.waiting, revoked=revoked)
        self._answer({"report": report.model_dump()})

    def _answer(self, fields: dict[str, Any]) -> None:
        """Send the outcome to the callers who have requested a reload since the last one."""
        callers, self._callers = self._callers, []
        for request_id in callers:
            self._supervisor.send_to_web({"kind": RESULT, "id": request_id, **fields})
