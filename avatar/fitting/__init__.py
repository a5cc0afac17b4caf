"""Registration of bodies to scans: shape, pose and place of the person under a scan's clothes."""
