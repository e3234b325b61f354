"""What a user asks for: mission, fault, detector, stack and platform, as plain values."""
