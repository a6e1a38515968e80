"""The LZF compression of binary PCD files."""


def decompress(data: bytes, size: int) -> bytes:
    r"""Return the `size` bytes that LZF data holds.

    A byte c < 32 is followed by c + 1 literal bytes. Any other gives a copy of (c >> 5) + 2 earlier bytes, of which
    a length of 9 takes one more byte into account; the distance has 13 bits.

    Raises:
        ValueError: data that end early, hold more or fewer bytes, or copy bytes from before their start.

    >>> decompress(b"\x01ab\x60\x01", 7)
    b'abababa'
    """
    out, i, end = bytearray(), 0, len(data)
    while i < end:
        control = data[i]
        i += 1
        if control < 32:
            length = control + 1
            if i + length > end:
                raise ValueError("LZF data that end early")
            out += data[i : i + length]
            i += length
        else:
            length = control >> 5
            if i + 1 + (length == 7) > end:
                raise ValueError("LZF data that end early")
            if length == 7:
                length += data[i]
                i += 1
            length += 2
            start = len(out) - ((control & 31) << 8) - data[i] - 1
            i += 1
            if start < 0:
                raise ValueError("LZF data that copy bytes from before their start")
            piece = out[start : start + length]
            while len(piece) < length:  # the copy overlaps what it writes
                piece += piece[: length - len(piece)]
            out += piece
        if len(out) > size:
            raise ValueError(f"LZF data of more than {size} bytes")
    if len(out) < size:
        raise ValueError(f"LZF data of {len(out)} bytes, not {size}")
    return bytes(out)
