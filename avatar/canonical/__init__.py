"""SCANimate's canonicalization: skinning weights as fields of space, and posed scans carried to the T-pose."""
