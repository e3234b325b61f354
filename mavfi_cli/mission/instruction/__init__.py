"""An instruction-level fault in a mission: scope, profile, plan, the node that is attacked."""
