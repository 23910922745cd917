"""Judge policies: compare artifacts, hold a policy against its recordings, decide which one to deploy."""
