"""The native entry of a kernel and its code in scope, for instruction-level faults.

A planner has two scopes. In isolation the kernel is the search, OMPL's `solve`, which always runs.
In a mission the kernel is the planner node's work for one request, with or without a search
(`node_scope`).

Call these functions in the kernel's process, after the kernel has run once (`autonomy.warm`): a
just-in-time compiled kernel has no address before that. The result can be sent to a tracer.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from elftools.elf.elffile import ELFFile

from mavfi_cli.autonomy import OUR_PLANNERS, canonical_planner
from mavfi_cli.core.errors import FaultError, UnknownName
from mavfi_cli.fi.tracer.image import (
    Function,
    Image,
    Location,
    Part,
    Region,
    executable_mapping,
)

KERNELS = ("point_cloud", "octomap", "collision_check", *OUR_PLANNERS, "control")

# A planner's code in libompl is contiguous: it is compiled from one source file with its templates.
# Classes that all planners call are in scope too. Each entry: mangled class name, text after it.
_OMPL = {"rrtstar": ("7RRTstar", ""), "rrt": ("3RRT", "E"), "rrtconnect": ("10RRTConnect", "")}
_OMPL_SHARED = ("4ompl4base20RealVectorStateSpace", "4ompl4base29PathLengthOptimizationObjective")
_OCTOMAP_INSERT = (
    "_ZN7octomap19OccupancyOcTreeBaseINS_10OcTreeNodeEE16insertPointCloudE"
    "RKNS_10PointcloudERKN8octomath7Vector3Edbb"
)
_OCTOMAP_INNER = (
    "_ZNK7octomap14OcTreeBaseImplINS_10OcTreeNodeENS_23AbstractOccupancyOcTreeEE14computeRayKeysE"
    "RKN8octomath7Vector3ES7_RNS_6KeyRayE",
    "_ZN7octomap19OccupancyOcTreeBaseINS_10OcTreeNodeEE10updateNodeERKNS_9OcTreeKeyEfb",
)
_OCTOMAP_WRITE = "_ZNK7octomap14AbstractOcTree5writeERSo"
_FCL_COLLIDE = (
    "_ZN3fcl7collideIdEEmPKNS_15CollisionObjectIT_EES5_RKNS_16CollisionRequestIS2_EE"
    "RNS_15CollisionResultIS2_EE"
)
_FCL_USED = (
    "3fcl7collideIdE", "3fcl6OcTreeIdE", "11obbDisjointIdE", "3fcl3OBBIdE7overlap",
    "ConvertBVImplIdNS_4AABBIdEENS_3OBBIdEE", "14computeChildBVIdE", "3fcl19CollisionGeometryIdE",
    "16collisionRecurseIdE", "3fcl4AABBIdE6center",
)  # fmt: skip
_PAGE = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelScope:
    """The entry and the code in scope of one kernel in one process.

    Attributes:
        entry: the instruction whose execution counts as one invocation of the kernel. The
            collision check enters once per tested point. A planner node enters where a request
            begins.
        objects: names of the objects in scope, regions included.
        regions: for `Image`: compiled code without a file, and objects partly in scope.
        inner: functions of the kernel. If it executes too many instructions to profile them all,
            invocations of these functions are sampled. For a planner node, windows that begin at
            them are sampled, and the first function is the search.
        end: an optional instruction. Nothing is attacked once it is reached, because only
            the output is written then.
    """

    kernel: str
    entry: Location
    objects: tuple[str, ...]
    regions: Mapping[str, Region | Part]
    inner: tuple[Location, ...] = ()
    end: Location | None = None


def kernel_scope(kernel: str) -> KernelScope:
    """Find the entry and the scope of a kernel in this process.

    Raises:
        UnknownName: the kernel does not exist; the message suggests the nearest.
        FaultError: the kernel has not run in this process yet.
    """
    if kernel not in KERNELS:
        raise UnknownName("kernel", kernel, KERNELS)
    if kernel in OUR_PLANNERS:
        return _planner(kernel)
    if kernel == "octomap":
        return _octomap()
    return _collision_check() if kernel == "collision_check" else _compiled_kernel(kernel)


def library_scope(library: str, function: str) -> KernelScope:
    """Return a scope whose entry is a library's function, with all code of the library in scope.

    Raises:
        UnknownName: this process has not loaded the library, or the library has no such function;
            the message suggests the nearest name.
    """
    entry = Image(os.getpid()).function(function, [library])
    return KernelScope(kernel=function, entry=entry, objects=(library,), regions={})


def compiled_scope(kernel: str, function: Any) -> KernelScope:
    """Find the entry and the scope of a numba function that has run in this process.

    The entry is the wrapper that Python calls. The hash of the compiled object identifies the
    build, because the code in memory contains addresses of the process.

    Args:
        kernel: Name of the kernel.
        function: The function, compiled with `core.compiled.compiled`.

    Raises:
        FaultError: The function has not run yet.
    """
    overloads = list(getattr(function, "overloads", {}).items())
    if not overloads:
        raise FaultError(f"{function} has no machine code, because it has not run in this process")
    signature, result = overloads[0]
    wrapper = result.fndesc.llvm_cpython_wrapper_name
    address = int(result.library.get_pointer_to_function(wrapper))
    name = f"numba:{function.__name__}"
    region = _object_region(function, signature, wrapper, address)
    entry = Location(name, address - region.span.start)
    return KernelScope(kernel=kernel, entry=entry, objects=(name,), regions={name: region})


def node_scope(node: str, planner: str) -> KernelScope:
    """Find the entry and the code in scope of a mission node that runs in this process.

    A planner node first reads the map and builds its obstacle grid; neither step is in scope. All
    later work up to the reply is in scope: the tests of straight segments and of pieces of the
    trajectory, and the search if there is one.

    Raises:
        UnknownName: the node or planner does not exist; the message suggests the nearest.
        FaultError: the node's kernel has not run in this process yet.
    """
    kernel = kernel_of_node(node, planner)
    scope = kernel_scope(kernel)
    return scope if kernel not in OUR_PLANNERS else _whole_request(scope)


def _whole_request(search: KernelScope) -> KernelScope:
    from mavfi_cli.autonomy.grid import path_free, segment_free
    from mavfi_cli.autonomy.octree import decode_leaves

    reader = compiled_scope("reader", decode_leaves)
    pieces = compiled_scope("pieces", path_free)
    segment = compiled_scope("segment", segment_free).entry
    return replace(
        search,
        entry=reader.entry,
        objects=(*search.objects, *pieces.objects),
        regions={**search.regions, **pieces.regions, **reader.regions},
        inner=(search.entry, segment, pieces.entry, *search.inner),
    )


def kernel_of_node(node: str, planner: str) -> str:
    """Return the kernel that a node runs, given the mission's planner.

    Raises:
        UnknownName: instruction-level faults cannot strike this planner.
    """
    if node != "planner":
        return node
    name = canonical_planner(planner)
    if name not in OUR_PLANNERS:
        raise UnknownName("planner for instruction-level faults", planner, OUR_PLANNERS)
    return name


def _compiled_kernel(kernel: str) -> KernelScope:
    from mavfi_cli.autonomy.point_cloud import back_project
    from mavfi_cli.autonomy.tracking import track

    return compiled_scope(kernel, track if kernel == "control" else back_project)


def _octomap() -> KernelScope:
    image = Image(os.getpid())
    library = _object_of(image, "liboctomap", "/pyoctomap.libs/")
    inner = tuple(image.function(name, [library]) for name in _OCTOMAP_INNER)
    return KernelScope(
        kernel="octomap",
        entry=image.function(_OCTOMAP_INSERT, [library]),
        objects=(library,),
        regions={},
        inner=inner,
        end=image.function(_OCTOMAP_WRITE, [library]),
    )


def _collision_check() -> KernelScope:
    image = Image(os.getpid())
    library = _object_of(image, "libfcl")
    part = _part([f for f in _functions_with(image, library, "OcTree", *_FCL_USED)
                  if _tests_spheres(f.name)])  # fmt: skip
    entry = image.function(_FCL_COLLIDE, [library])
    return KernelScope(
        kernel="collision_check", entry=entry, objects=(library,), regions={library: part}
    )


def _tests_spheres(symbol: str) -> bool:
    """Return True if a function of FCL takes part in testing a sphere against an octree."""
    if "OcTree" in symbol and "Sphere" in symbol:
        return "libccd" in symbol
    return any(name in symbol for name in _FCL_USED)


def _planner(kernel: str) -> KernelScope:
    from mavfi_cli.autonomy.grid import segment_free

    image = Image(os.getpid())
    library = _object_of(image, "libompl")
    name, end = _OMPL[kernel]
    motion = f"geometric{name}6Motion"
    wanted = (f"ompl9geometric{name}{end}", motion, *_OMPL_SHARED)
    solve = f"_ZN4ompl9geometric{name}5solveERKNS_4base27PlannerTerminationConditionE"
    part = _part(_functions_with(image, library, *wanted))
    segment = compiled_scope("segment", segment_free)
    return KernelScope(
        kernel=kernel,
        entry=image.function(solve, [library]),
        objects=(library, *segment.objects),
        regions={library: part, **segment.regions},
        inner=_nearest(image, library, motion),
    )


def _nearest(image: Image, library: str, motion: str) -> tuple[Location, ...]:
    """Return the entries of the nearest-neighbour searches that a planner's tree may call."""
    return tuple(
        Location(library, function.start)
        for function in _functions_with(image, library, motion)
        if "NearestNeighborsGNATNoThreadSafety" in function.name
        and ("E7nearestE" in function.name or "E8nearestKE" in function.name)
        and "4Node" not in function.name
    )


def _functions_with(image: Image, library: str, *parts: str) -> list[Function]:
    """Return the functions of a library whose names contain at least one of `parts`."""
    named = image.named(library).functions
    return [function for function in named if any(part in function.name for part in parts)]


def _object_of(image: Image, prefix: str, folder: str = "") -> str:
    for name in image.names:
        if name.startswith(prefix) and folder in image.path_of(name):
            return name
    raise FaultError(f"{prefix} is not loaded yet: run the kernel once before asking for its scope")


def _part(functions: Iterable[Function]) -> Part:
    """Return the code of the functions, including any gap of less than a page between two."""
    spans: list[range] = []
    for function in functions:
        start, end = function.start, function.start + function.size
        if spans and function.size and start - spans[-1].stop < _PAGE:
            spans[-1] = range(spans[-1].start, max(spans[-1].stop, end))
        elif function.size:
            spans.append(range(start, end))
    return Part(text=tuple(spans))


def _object_region(dispatcher: Any, signature: Any, wrapper: str, address: int) -> Region:
    """Return the code of a function that numba has compiled.

    If numba's cache has the compiled object, it is that object's text. Otherwise it is the whole
    executable mapping that contains `address`.
    """
    code = _cached_object(dispatcher, signature)
    if code is not None:
        elf: Any = ELFFile(io.BytesIO(code))
        symbols = elf.get_section_by_name(".symtab").get_symbol_by_name(wrapper)
        if symbols:
            section = elf.get_section(symbols[0]["st_shndx"])
            start = address - symbols[0]["st_value"]
            return Region(
                span=range(start, start + section["sh_size"]),
                build_id="sha256:" + hashlib.sha256(code).hexdigest()[:40],
            )
    return Region(span=executable_mapping(os.getpid(), address))


def _cached_object(dispatcher: Any, signature: Any) -> bytes | None:
    """Return a function's relocatable object from numba's cache, or None if it is not cached."""
    cache = getattr(dispatcher, "_cache", None)
    try:
        key = cache._index_key(signature, dispatcher.targetctx.codegen())  # type: ignore[union-attr]
        payload = cache._cache_file.load(key)  # type: ignore[union-attr]
        kind, data = payload[0][1], payload[0][2]
    except (AttributeError, TypeError, IndexError):
        return None
    return bytes(data[0]) if kind == "object" else None
