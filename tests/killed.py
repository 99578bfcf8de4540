"""Runs that end at one of their file operations, in children of this process: a power failure, or an error, there."""

import os
import signal
import sys
import warnings

# What changes something on the disk, as the interpreter reports it (sys.addaudithook); the rest is wrapped.
EVENTS = {
    "os.chmod", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.symlink", "os.truncate", "os.utime",
}  # fmt: skip
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Point:
    """Counts the file operations, and ends the run at one of them."""

    def __init__(self, number, end):
        self.passed, self.number, self.end = 0, number, end

    def __call__(self, *_):
        self.passed += 1
        if self.passed == self.number:
            self.end()

    def hook(self, event, arguments):
        if event in EVENTS or (event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITING):
            self()


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


def ends_at(number, action, wrapped=(), end=kill):
    """Run `action` in a child that ends before its file operation of this number.

    Args:
        number: of the operation, from 1.
        action: what the child does.
        wrapped: (module, name) of functions that are file operations too.
        end: what happens there.

    Returns:
        Whether there is such an operation.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other tests may have left threads, which stay behind
        child = os.fork()
    if child == 0:
        point = Point(number, end)
        try:
            for module, name in ((os, "fsync"), *wrapped):
                setattr(module, name, before(point, getattr(module, name)))
            sys.addaudithook(point.hook)
            action()
        except BaseException:
            os._exit(4)
        finally:
            os._exit(3 if point.passed >= number else 0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status) or os.waitstatus_to_exitcode(status) in (3, 4)


def before(point, function):
    def counted(*arguments):
        point()
        return function(*arguments)

    return counted
