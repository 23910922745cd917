"""The artifact, one file with a policy and all that it needs: write it, check it, describe it."""
