"""From recordings to an evaluated policy: what the commands of both stages share."""
