"""SCANimate's canonicalization: skinning weights as fields of space, and posed scans unposed to the T-pose."""
