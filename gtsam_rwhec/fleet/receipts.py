"""Receipts that stay in the output beside the files: who comes later reads them, and does not do the work again."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fleet.stores import exists, read_bytes, write_once
from gtsam_rwhec.fleet.tasks import Receipt


def below(output: str, file: str) -> str:
    """The URL of a file of the output."""
    return f"{output.rstrip('/')}/{file}"


def kept_receipt(output: str, file: str) -> Receipt | None:
    """The receipt of a file that is there and whole; None where it is still to be made."""
    url = below(output, _place(file))
    if not (exists(url) and exists(below(output, file))):
        return None
    try:
        return replace(Receipt(**json.loads(read_bytes(url))), was_there=True)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{url} is no receipt of a fleet; remove it, and run again") from error


def keep_receipt(output: str, receipt: Receipt) -> Receipt:
    """Keep the receipt of a file that is written; it comes last, so that a file with a receipt is whole."""
    write_once(below(output, _place(receipt.file)), json.dumps(asdict(receipt), sort_keys=True).encode())
    return receipt


def _place(file: str) -> str:
    return f"{file}.receipt.json"
