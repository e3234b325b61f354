"""What a run folder says, as one hash: equal flights, equal hashes, whatever wrote the files."""

import hashlib
import json

import pyarrow.parquet as pq

# Keys of the configuration, and of its detector, that older records do not have.
_NEW, _NEW_OF_DETECTOR = ("stack", "world_seed"), ("any_stack", "watch")
_HOST = ("host", "versions")


def record_digest(folder):
    """SHA-256 of a run's packets, tables and result, without what tells of host and versions."""
    digest = hashlib.sha256((folder / "flight.tlog").read_bytes())
    for name in ("trace", "plans", "kernels"):
        table = pq.read_table(folder / f"{name}.parquet")
        for column in sorted(table.column_names):
            digest.update(f"{name}.{column}".encode())
            digest.update(repr(table[column].to_pylist()).encode())
    result = json.loads((folder / "result.json").read_text())
    for key in _HOST:
        del result[key]
    for key in _NEW:
        result["config"].pop(key, None)
    for key in _NEW_OF_DETECTOR:
        (result["config"]["detector"] or {}).pop(key, None)
    fault = result["fault"] or {}
    fault.pop("build_ids", None)  # of the code's file, not of the code
    if isinstance(fault.get("injection"), dict):
        fault["injection"].pop("address", None)  # where the code was loaded: any import moves it
    digest.update(json.dumps(result, sort_keys=True).encode())
    return digest.hexdigest()
