"""The papers' rivals, one file a method, written from their papers."""
