"""SCANimate's implicit avatar: a pose-aware signed distance, its colours, its surface, and the surface posed."""
