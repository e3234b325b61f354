"""x86-64: registers, instructions, and the traces that single steps leave."""
