"""Many runs instead of one: isolated kernels, and missions by the thousand."""
