"""Reading zip files from outside (npz, checkpoints): strictly, in bounded memory.

Programs differ in where they look for a zip's end record, which of two names or sizes they believe, and what they skip,
so one may see harmless members where another finds a program. Here a file has one directory and one end record, at its
very end; the members follow one another from the first byte on, and their headers say the same as the directory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

_LOCAL, _CENTRAL, _END = struct.Struct("<4s5H3I2H"), struct.Struct("<4s6H3I5H2I"), struct.Struct("<4s4H2IH")
_LARGE_END, _LOCATOR = struct.Struct("<4sQ2H2I4Q"), struct.Struct("<4sIQI")
_SIZES_AFTER = struct.Struct("<4s3I"), struct.Struct("<4sI2Q")  # follow a member whose header could not know them
_STORED, _DEFLATED, _LATE = 0, 8, 8
_FLAGS = _LATE | 0x0806  # deflate's level and UTF-8 change nothing for us
_ROOM, _RATIO, _MOST = 2**28, 100, 100_000


class _Member(NamedTuple):
    flags: int
    method: int
    numbers: tuple[int, int, int]  # checksum, bytes in the file, bytes unpacked
    start: int  # of its bytes in the file


class Archive:
    """The members of an open zip file; none is unpacked before it is asked for.

    Attributes:
        sizes: bytes of each member by name; together at most 256 MiB and 100 times the file's length.
        length: of the file, bytes.

    Raises:
        ValueError: another format, records that disagree, bytes that belong to no member, or implausible sizes.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.length, self._members = file, file.seek(0, 2), {}
        count, begin, end = self._end()
        directory, at, place = self._bytes(begin, end - begin), 0, 0
        for _ in range(count):
            name, member, at = _entry(directory, at)
            if name in self._members or member.start != place:
                raise ValueError(f"{name!r} is there twice, or does not begin where the member before it ends")
            self._members[name], place = self._located(name, member)
        if (at, place) != (len(directory), begin):
            raise ValueError("bytes that belong to no member")
        self.sizes = {name: member.numbers[2] for name, member in self._members.items()}
        if (total := sum(self.sizes.values())) > _ROOM + _RATIO * self.length:
            raise ValueError(f"{total / 1e9:.1f} GB in {self.length / 1e6:.2f} MB, more than data can be packed")

    def read(self, name: str) -> bytearray:
        """A member's bytes; ValueError or zlib.error unless they fit its size and checksum."""
        member, place = self._members[name], 0
        data = memoryview(bytearray(member.numbers[2]))
        for part in self._parts(member):
            data[place : place + len(part)] = part  # refuses more than there is room for
            place += len(part)
        if place != len(data) or zlib.crc32(data) != member.numbers[0]:
            raise ValueError(f"{name} does not fit its size and checksum")
        return data.obj

    def head(self, name: str, count: int) -> bytes:
        """A member's first bytes, at most `count`."""
        return next(self._parts(self._members[name], count), b"")[:count]

    def _parts(self, member: _Member, most: int = 2**20) -> Iterator[bytes]:
        unpack, end = zlib.decompressobj(-15), member.start + member.numbers[1]
        for place in range(member.start, end, most):
            part, more = self._bytes(place, min(most, end - place)), True
            if member.method == _STORED:
                yield part
            while member.method == _DEFLATED and (part or more) and not unpack.unused_data:
                unpacked = unpack.decompress(part, most)
                part, more = unpack.unconsumed_tail, len(unpacked) == most
                yield unpacked
        if member.method == _DEFLATED and (unpack.unused_data or not unpack.eof):
            raise ValueError("packed bytes that do not end where they should")

    def _bytes(self, place: int, count: int) -> bytes:
        if not 0 <= place <= place + count <= self.length:
            raise ValueError("it ends too early")
        self._file.seek(place)
        return self._file.read(count)

    def _end(self) -> tuple[int, int, int]:
        """Number of members, begin and end of the directory."""
        end = self.length - _END.size
        kind, *disks, here, count, size, begin, comment = _END.unpack(self._bytes(end, _END.size))
        if kind != b"PK\5\6" or here != count or any(disks) or comment:
            raise ValueError("no zip file, or one that does not end with its end record")
        locator = self._bytes(max(end - _LOCATOR.size, 0), _LOCATOR.size)
        if locator[:4] == b"PK\6\7":  # torch always writes the second end record, for large files
            end -= _LOCATOR.size + _LARGE_END.size
            large = _LARGE_END.unpack(self._bytes(end, _LARGE_END.size))
            small, (count, size, begin) = (count, size, begin), large[7:]
            agree = all(x in (y, top) for x, y, top in zip(small, large[7:], (0xFFFF, _TOP, _TOP), strict=True))
            agree &= large[:2] + large[4:7] == (b"PK\6\6", 44, 0, 0, count)
            if not agree or locator != _LOCATOR.pack(b"PK\6\7", 0, end, 1):
                raise ValueError("two end records that disagree")
        if begin + size != end or count > min(size // _CENTRAL.size, _MOST):
            raise ValueError("a directory of another size, or of too many members")
        return count, begin, end

    def _located(self, name: str, member: _Member) -> tuple[_Member, int]:
        """A member with the start of its bytes, once its own header agrees with the directory; and where it ends."""
        header = _LOCAL.unpack(self._bytes(member.start, _LOCAL.size))
        kind, _, flags, method, _, _, crc, stored, size, names, extra = header
        own, start = self._bytes(member.start + _LOCAL.size, names + extra), member.start + _LOCAL.size + names + extra
        size, stored = _large(own[names:], size, stored)
        if (kind, flags, method, own[:names]) != (b"PK\3\4", member.flags, member.method, name.encode()):
            raise ValueError(f"{name!r} has another header in the directory")
        end, after, late = start + member.numbers[1], [0], flags & _LATE
        if late:
            wanted = (b"PK\7\x08", *member.numbers)
            after = [x.size for x in _SIZES_AFTER if x.unpack(self._bytes(end, x.size)) == wanted]
        if not after or (crc, stored, size) not in (member.numbers, (0, 0, 0) if late else None):
            raise ValueError(f"{name!r} has other sizes in the directory")
        return member._replace(start=start), end + after[0]


_TOP = 0xFFFFFFFF  # stands for a number that is too large for its place


def _entry(directory: bytes, at: int) -> tuple[str, _Member, int]:
    """Name and member of the directory's entry at a place, with the start of its header; and the place of the next."""
    fields = _CENTRAL.unpack_from(directory.ljust(at + _CENTRAL.size), at)
    kind, _, _, flags, method, _, _, crc, stored, size, names, extra, comment, disk, _, _, start = fields
    at += _CENTRAL.size
    name, further = directory[at : at + names].decode(), directory[at + names : at + names + extra]
    size, stored, start = _large(further, size, stored, start)
    packed = method == _DEFLATED or (method == _STORED and stored == size)
    if kind != b"PK\1\2" or disk or comment or flags & ~_FLAGS or not packed:
        raise ValueError(f"{name!r} is packed in a way that is not read; save it with numpy or torch")
    return name, _Member(flags, method, (crc, stored, size), start), at + names + extra


def _large(further: bytes, *numbers: int) -> list[int]:
    """A header's numbers, each one that is too large for its place from the header's further fields."""
    large = iter(())
    while len(further) >= 4:
        kind, count = struct.unpack("<2H", further[:4])
        if kind == 1:
            own = further[4 : 4 + count]
            large = iter([int.from_bytes(own[i : i + 8], "little") for i in range(0, len(own) - 7, 8)])
        further = further[4 + count :]
    return [next(large, x) if x == _TOP else x for x in numbers]
