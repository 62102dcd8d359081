"""An instrument's clock is late, all of them or one."""

from optodrive.physics.term import Term, TermParameter


class ClockOffset(Term):
    """An instrument's clock is late, all of them or one."""

    key = "clock_offset"
    parameters = (
        TermParameter("temperature", "s", 1e-4, -5e-3, 5e-3, "0.05 to 3 ms either way"),
        TermParameter("displacement", "s", 1e-4, -5e-3, 5e-3, "as above"),
        TermParameter("force", "s", 1e-4, -5e-3, 5e-3, "as above"),
        TermParameter("mirrors", "s", 1e-4, -5e-3, 5e-3, "as above"),
    )
    cannot_add_heat = True
    signature = "every edge, in proportion to the slope"


TERM = ClockOffset()
