"""Which instructions branch, and the flags whose flip inverts a conditional jump."""

from __future__ import annotations

from typing import Any

from capstone import x86

_BRANCHES = {x86.X86_GRP_JUMP, x86.X86_GRP_CALL, x86.X86_GRP_RET, x86.X86_GRP_IRET}
# Intel SDM volume 2, Jcc.
_CF, _PF, _ZF, _SF, _OF = 0, 2, 6, 7, 11
JUMP_FLAGS = {
    "jo": (_OF,), "jno": (_OF,), "js": (_SF,), "jns": (_SF,), "jp": (_PF,), "jnp": (_PF,),
    "je": (_ZF,), "jne": (_ZF,), "jb": (_CF,), "jae": (_CF,), "jl": (_SF,), "jge": (_SF,),
    "jbe": (_CF, _ZF), "ja": (_CF, _ZF), "jle": (_ZF, _SF), "jg": (_ZF, _SF),
}  # fmt: skip


def branches(found: Any) -> bool:
    """True for a jump, a call or a return, as capstone decodes it."""
    return bool(_BRANCHES.intersection(found.groups))


def inverting_bits(jump: str, flags: int) -> tuple[int, ...]:
    """The flags to flip so that a conditional jump goes the other way, given all flags.

    Where it tests two conditions ("below" or "equal"), each that holds is undone; if none does,
    "equal" is made to hold.
    """
    if len(JUMP_FLAGS[jump]) == 1:
        return JUMP_FLAGS[jump]
    less = _CF if _CF in JUMP_FLAGS[jump] else _SF
    below = flags >> less & 1 if less == _CF else (flags >> _SF ^ flags >> _OF) & 1
    equal = flags >> _ZF & 1
    if not (below or equal):
        return (_ZF,)
    return tuple(sorted([less] * below + [_ZF] * equal))
