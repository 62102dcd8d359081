"""Parameter sets with hidden terms, as `optodrive simulate --truth` reads them."""

from optodrive.physics.parameters import FORMAT, VERSION
from optodrive.physics.terms import discover_terms
from sound_files import write_toml


def write_truth(path, terms):
    """Write a truth with term → parameter → SI value. Return its path."""
    stated = {
        key: {
            item.name: {"value": float(values[item.name]), "unit": item.unit, "source": "hidden"}
            for item in discover_terms()[key].parameters
        }
        for key, values in terms.items()
    }
    head = {"format": FORMAT, "version": VERSION, "name": "hidden", "base": "calibrated", "claims": ""}
    write_toml(path, head | {"terms": stated})
    return path
