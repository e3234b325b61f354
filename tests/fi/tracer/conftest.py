"""The small native programs that are traced."""

from native_programs import native_program, start  # noqa: F401
