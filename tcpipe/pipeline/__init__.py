"""Plain calls that run the stages over files: ingest logs, add maps, build datasets."""
