"""The wire format in JavaScript against the protocol's vectors."""

import json
import subprocess
import tomllib

import pytest
from javascript import HERE, javascript

PROTOCOL = HERE.parents[1] / "firmware_protocol"
VECTORS = sorted((PROTOCOL / "vectors").glob("*.toml"))
REFUSED = tomllib.loads((PROTOCOL / "refused.toml").read_text())["case"]


def run_script(script, argument):
    command = javascript("--input-type=module", "-e", script, json.dumps(argument))
    return json.loads(subprocess.run(command, cwd=HERE, check=True, capture_output=True, text=True).stdout)


CODEC = """
import { decode, encode } from "./wire.mjs";
const answers = JSON.parse(process.argv[1]).map((wire) => {
  const message = decode(Buffer.from(wire, "hex").subarray(0, -1));
  if (message.error) return message;
  const again = encode(message.name, message, { seq: message.seq, session: message.frameSession });
  return { ...message, again: again.toString("hex") };
});
process.stdout.write(JSON.stringify(answers));
"""


@pytest.fixture(scope="module")
def decoded():
    """Return a function that returns what JavaScript makes of a frame."""
    frames = [tomllib.loads(path.read_text())["wire"] for path in VECTORS] + [case["wire"] for case in REFUSED]
    return dict(zip(frames, run_script(CODEC, frames), strict=True)).__getitem__


@pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)
def test_each_vector_decodes_to_its_fields_and_encodes_to_its_bytes(path, decoded):
    vector = tomllib.loads(path.read_text())
    message = decoded(vector["wire"])
    assert message["again"] == vector["wire"]
    assert (message["name"], message["seq"], message["frameSession"]) == (
        vector["message"],
        vector["seq"],
        vector["session"],
    )
    named = tomllib.loads((PROTOCOL / "messages.toml").read_text())["enumerations"]
    fields = vector["fields"] | vector["fields"].get("limits", {})
    for name, value in fields.items():
        table = named["nak_reason"] if (message["name"], name) == ("NAK", "reason") else named.get(name)
        if name != "limits":
            assert message[name] == (table[value] if table else value), name


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case["what"])
def test_each_refused_frame_counts_as_it_must(case, decoded):
    assert decoded(case["wire"]) == {"error": case["counter"]}
