"""A disk that is full: files of this process that cannot grow."""

import resource
from contextlib import contextmanager


@contextmanager
def largest_file(size):
    """Refuse to let a file grow beyond `size` bytes, with OSError; the write before it is cut there."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
