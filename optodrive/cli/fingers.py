"""`optodrive fingers`: report fingertips to the daemon from a file, as a tracker would."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import UrlOption
from optodrive.core.daemon_url import DEFAULT_URL


def fingers(
    script: Annotated[
        Path, typer.Argument(metavar="FILE.csv", help="time_s,number,x_m,y_m,radius_m: a fingertip a row.")
    ],
    repeat: Annotated[bool, typer.Option("--repeat", help="Begin again at the end, until Ctrl-C.")] = False,
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Report scripted fingertips, for which standing frames are refreshed first."""
    import time

    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.display import Display
    from optodrive.client.finger_script import read_finger_script

    reports = read_finger_script(script)
    with end_as_interrupted(), Display(url) as display, display.fingers() as connection:
        begin_s = time.monotonic()
        while True:
            for report in reports:
                time.sleep(max(0.0, begin_s + report.at_s - time.monotonic()))
                connection.send(report.places)
            if not repeat:
                break
            begin_s += reports[-1].at_s
    print(f"{len(reports)} reports of fingertips in {reports[-1].at_s:.3g} s")
