"""The verbs behind the commands: each takes one settings class and chains the rooms below."""
