"""Messages of MAVLink's newer definitions that pymavlink's `common` dialect lacks.

Source: https://mavlink.io/en/messages/common.html. Fields are those of the wire, in its order.
"""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common

_Field = tuple[str, str, int]  # name, type, number of elements (1: a scalar)
_CODES = {"uint8_t": "B", "uint16_t": "H", "uint32_t": "I", "char": "s"}


def _message_class(number: int, name: str, crc_extra: int, *fields: _Field) -> Any:
    """Return a message class that the codec treats as one of the dialect's."""
    names, types, lengths = (list(column) for column in zip(*fields, strict=True))
    layout = "<" + "".join(
        f"{length if length > 1 else ''}{_CODES[kind]}" for _, kind, length in fields
    )

    def build(self: Any, *values: Any) -> None:
        common.MAVLink_message.__init__(self, number, name)
        for field, kind, value in zip(names, types, values, strict=True):
            setattr(self, f"_{field}_raw" if kind == "char" else field, value)

    return type(
        f"MAVLink_{name.lower()}_message",
        (common.MAVLink_message,),
        {
            "id": number,
            "msgname": name,
            "fieldnames": names,
            "ordered_fieldnames": names,
            "fieldtypes": types,
            "lengths": [1 if kind == "char" else n for kind, n in zip(types, lengths, strict=True)],
            "array_lengths": [length if length > 1 else 0 for length in lengths],
            "orders": list(range(len(names))),
            "crc_extra": crc_extra,
            "unpacker": struct.Struct(layout),
            "__init__": build,
        },
    )


ProtocolVersion = _message_class(
    300, "PROTOCOL_VERSION", 217,
    ("version", "uint16_t", 1), ("min_version", "uint16_t", 1), ("max_version", "uint16_t", 1),
    ("spec_version_hash", "uint8_t", 8), ("library_version_hash", "uint8_t", 8),
)  # fmt: skip
ComponentInformation = _message_class(
    395, "COMPONENT_INFORMATION", 0,
    ("time_boot_ms", "uint32_t", 1), ("general_metadata_file_crc", "uint32_t", 1),
    ("peripherals_metadata_file_crc", "uint32_t", 1), ("general_metadata_uri", "char", 100),
    ("peripherals_metadata_uri", "char", 100),
)  # fmt: skip
ComponentMetadata = _message_class(
    397, "COMPONENT_METADATA", 182,
    ("time_boot_ms", "uint32_t", 1), ("file_crc", "uint32_t", 1), ("uri", "char", 100),
)  # fmt: skip
AvailableModes = _message_class(
    435, "AVAILABLE_MODES", 134,
    ("custom_mode", "uint32_t", 1), ("properties", "uint32_t", 1),
    ("number_modes", "uint8_t", 1), ("mode_index", "uint8_t", 1), ("standard_mode", "uint8_t", 1),
    ("mode_name", "char", 35),
)  # fmt: skip

ADDED: dict[int, Any] = {
    message.id: message
    for message in (ProtocolVersion, ComponentInformation, ComponentMetadata, AvailableModes)
}
"""Message classes by id."""
