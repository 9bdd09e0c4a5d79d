"""Budgets: how much memory, how many parts and how many pixels a file of a given size may cost to read.

No input is trusted. A few bytes can claim, or decompress to, many gigabytes; so every reader of logs and images checks
its budget before it decompresses, decodes or counts. Each budget is a constant part, for any file, plus a part that
grows with the file. Together they keep a crafted file below 200 MB of memory beyond its own size, and a small one
below two seconds.

The figures of honest files were measured on 2026-11-22 (tests/logs/test_hostile_logs.py has logs of each kind):

- Opened bytes for each byte of a log: poses 2 to 48, the shipped logs 1 to 2. Raw images that are black without a bit
  of noise reach 2,200 to 4,300 (640 x 480, zstd, chunks of 768 KiB to 4 MiB); `OPENED` alone has room for 2,600.
- Parts for each byte of a log: at most 5 (thirty frames that never move, JSON, zstd).
- Pixels for each byte of an image: black JPEG 85, black PNG up to 1,025; images with noise 1 to 10.
"""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import BudgetError

MIB = 1 << 20

#: Bytes. A chunk of a log has at most this much when decompressed. Recorders write chunks of 1 to 4 MiB, and larger
#: ones only for larger messages, such as a raw image of 19 megapixels in colour.
CHUNK = 56 * MIB
#: A chunk may have more than `CHUNK` by this share of the file's size: large files may have large chunks.
CHUNK_SHARE = 0.25
#: Bytes. Chunks that overlap in time are open together; they and their decoded messages take at most this much.
OPEN = 96 * MIB
#: Chunks that are open together may take more than `OPEN` by this share of the file's size.
OPEN_SHARE = 0.5
#: Bytes. All chunks of a log have at most this much when decompressed, which takes less than a second.
OPENED = 768 * MIB
#: Decompressed bytes for each byte of the file: twenty times what poses reach. Only logs of nothing but black raw
#: images reach more; they have `OPENED` too.
OPENED_FOR_A_BYTE = 1024
#: Bytes. A message in JSON or protobuf has at most this much; decoding holds up to four copies of it.
MESSAGE = 24 * MIB
#: A message may have more than `MESSAGE` by this share of the file's size: the file has the bytes of real images.
MESSAGE_SHARE = 0.25
#: Parts of a log: records, messages, metadata entries, numbers and strings that are read one by one. Each takes one or
#: two microseconds; slower parts count as several, faster ones as a fraction: see the constants below.
PARTS = 300_000
#: Parts for each byte of the file. Poses that never move, in JSON, reach 5.
PARTS_FOR_A_BYTE = 6
#: A number, string or list of a CDR message counts as this many parts if the reader has to step over it.
PARTS_OF_A_WALK = 2
#: This many numbers, strings and lists in JSON count as one part.
JSON_OF_A_PART = 4
#: A pose in JSON or protobuf counts as this many parts, in addition to the parts of its text.
PARTS_OF_A_POSE = 3
#: Parts of one message. A board of 100 x 100 squares has 20,000 numbers for its corners, and as many again in JSON.
PARTS_OF_A_MESSAGE = 100_000
#: Levels of messages or lists inside one another. ROS's and Foxglove's own have at most six.
LEVELS = 16
#: Bytes. One schema's definition is read only if it has at most this much; ROS's largest have 60 kB.
SCHEMA = MIB // 2
#: Bytes. All definitions that are read for a log have at most this much, a second's work. Robots have up to 1 MB.
SCHEMAS_READ = 2 * MIB
#: Bytes. All schemas of a log together, read or not.
SCHEMAS = 16 * MIB
#: Bytes. All channels of a log together; a thousand channels with their quality of service take 1 MB.
CHANNELS = 2 * MIB
#: Message types that the descriptors of one protobuf schema define; Foxglove's have at most ten.
MESSAGE_TYPES = 1000
#: Bytes. A file of one cloud, and what it decompresses to, have at most this many: eight million points of 32 bytes.
CLOUD = 256 * MIB
#: Bytes of one point with all of its fields.
POINT = 4096
#: Bytes of text with poses for a folder of images: half a million lines.
POSES_TEXT = 64 * MIB

#: Pixels that any compressed image may have, whatever its size in bytes.
PIXELS = 1 << 24
#: Pixels for each byte of a compressed image. Black JPEG reaches 85; black PNG of up to 22 megapixels fits as well.
PIXELS_FOR_A_BYTE = 256
#: Bytes that decoding a compressed image may take; each byte of the image allows `DECODED_FOR_A_BYTE` more.
DECODED = 160_000_000
DECODED_FOR_A_BYTE = 4
#: Pixels of the images that one thread decodes before it looks for targets: five images of two megapixels. Their
#: detections are saved together, so a killed run loses at most these.
PIXELS_TOGETHER = 1 << 23
#: Scans of a JPEG. Encoders write up to 12; each takes a pass over all pixels, and needs 20 bytes of the file.
SCANS = 64


class LogBudget:
    """What reading a log may cost. `size` is the bytes of its file, or of all files of a bag."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.chunk = CHUNK + int(CHUNK_SHARE * size)  #: decompressed bytes that one chunk may have
        self.open = OPEN + int(OPEN_SHARE * size)  #: bytes of chunks that are open together
        self.opened = OPENED + OPENED_FOR_A_BYTE * size  #: decompressed bytes of all chunks in one pass
        self.message = MESSAGE + int(MESSAGE_SHARE * size)  #: bytes of one message in JSON or protobuf
        self.parts = PARTS + PARTS_FOR_A_BYTE * size  #: parts that may be read in one pass over the log


class Spending:
    """The cost of one pass over a log, compared with the log's budget.

    Every method raises a BudgetError, which names the file, once the pass costs more than the budget has.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self.budget = LogBudget(size)
        self._parts = self._opened = self._schemas = 0

    def begin_pass(self) -> None:
        """Start counting again, as the log is read once more. Schemas are kept, so their cost is not counted again."""
        self._parts = self._opened = 0

    def take_parts(self, count: int) -> None:
        """Count parts that were read, or that are about to be read."""
        self._parts += count
        if self._parts > self.budget.parts:
            raise BudgetError(
                f"{self.path}: more than {self.budget.parts} messages, records, numbers and strings are in it, and a "
                f"log of {self.budget.size} bytes may have no more. It is damaged, or made to exhaust who reads it."
            )

    def take_opened(self, count: int) -> None:
        """Count the decompressed bytes of a chunk before it is opened."""
        self._opened += count
        self.check_opened(self._opened)

    def check_opened(self, total: int) -> None:
        """Check the number of decompressed bytes of all chunks together."""
        if total > self.budget.opened:
            raise BudgetError(
                f"{self.path}: its chunks yield {total} bytes or more, and those of a log of {self.budget.size} bytes "
                f"may yield {self.budget.opened}. It is damaged, or made to exhaust who reads it."
            )

    def take_schema(self, size: int) -> None:
        """Count the bytes of a definition that is about to be read."""
        self._schemas += size
        if self._schemas > SCHEMAS_READ:
            raise BudgetError(
                f"{self.path}: the definitions of its messages have more than {SCHEMAS_READ} bytes. It is damaged, or "
                "made to exhaust who reads it."
            )


def pixel_budget(size: int, bytes_a_pixel: int) -> int:
    """Pixels that a compressed image of `size` bytes may have, if decoding takes `bytes_a_pixel` for each pixel."""
    by_memory = (DECODED + DECODED_FOR_A_BYTE * size) // bytes_a_pixel
    return min(PIXELS + PIXELS_FOR_A_BYTE * size, by_memory)
