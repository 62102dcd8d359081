"""Results of a stream's frames, and the counts that lose none."""

from optodrive.client.stream import RESULTS_MAX, FrameCounts, ResultBuffer
from optodrive.daemon.responses.messages import FrameResult


def test_counts_lose_no_frame_that_the_reader_leaves():
    buffer, frames = ResultBuffer(), 4 * RESULTS_MAX
    for frame in range(frames):
        buffer.add(FrameResult(frame=frame, status="planned", plan="p").to_json())
        end = [
            {"status": "done", "executed": 0},
            {"status": "superseded", "executed": 3},
            {"status": "superseded", "superseded_by": frame + 1},
            {"status": "stopped", "executed": 0, "error": "STOP"},
        ][frame % 4]
        buffer.add(FrameResult(frame=frame, **end).to_json())
    assert len(buffer.drain()) == RESULTS_MAX
    assert buffer.counts == FrameCounts(shown=frames // 2, superseded=frames // 4, other=frames // 4)
