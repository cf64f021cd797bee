"""Data model of a session: manifest, tables, storage, stages, skeletons, errors and registries."""
