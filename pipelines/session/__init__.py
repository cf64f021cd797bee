"""What a session is: manifest, tables, storage, stages, skeletons, errors and registries."""
