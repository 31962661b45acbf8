"""Every error a user can meet: a stable code, the exit code of the contract, and what to change."""

from __future__ import annotations

from typing import ClassVar


class EpiTransferError(Exception):
    """Root of all errors that are explained to the user instead of shown as a traceback.

    Args:
        code: Stable identifier, "E-AREA-NN".
        message: What is wrong, one line.
        where: File, row or configuration key it was found at.
        found: What was found.
        expected: What was expected.
        hint: What to change.
    """

    exit_code: ClassVar[int] = 1

    def __init__(
        self, code: str, message: str, *, where: str = "", found: str = "", expected: str = "", hint: str = ""
    ) -> None:
        super().__init__(code, message)
        self.code = code
        self.message = message
        self.where = where
        self.found = found
        self.expected = expected
        self.hint = hint

    def __reduce__(self) -> tuple[object, ...]:
        """Keeps the keyword fields when the error crosses a process boundary."""
        return (_rebuild, (type(self), self.code, self.message, self.where, self.found, self.expected, self.hint))

    def __str__(self) -> str:
        labels = ("where", "found", "expected", "hint")
        told = [f"  {label:<9}{value}" for label in labels if (value := getattr(self, label))]
        return "\n".join([f"error[{self.code}]: {self.message}", *told])


def _rebuild(
    kind: type[EpiTransferError], code: str, message: str, where: str, found: str, expected: str, hint: str
) -> EpiTransferError:
    return kind(code, message, where=where, found=found, expected=expected, hint=hint)


class UsageError(EpiTransferError):
    """Wrong command line or configuration."""

    exit_code = 2


class InputError(EpiTransferError):
    """Input unreadable, truncated or of the wrong schema."""

    exit_code = 3


class UndeterminedError(EpiTransferError):
    """The data do not say (frame, height datum, clock, intrinsics) and the user must."""

    exit_code = 4


class NothingLeftError(EpiTransferError):
    """Valid input of which nothing survives: no pairs, no overlap with the LiDAR."""

    exit_code = 5


class ResourceError(EpiTransferError):
    """Out of memory, disk, permission or device."""

    exit_code = 6


class MissingPartError(EpiTransferError):
    """An optional part is not installed; the hint is the command that installs it."""

    exit_code = 7


class TooManyFailuresError(EpiTransferError):
    """Finished, but more items failed than max_failed_share allows."""

    exit_code = 8
