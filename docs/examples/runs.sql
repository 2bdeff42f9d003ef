-- Segments of all runs that count, in DuckDB: replace the recipe_id.
CREATE VIEW runs AS
WITH newest AS (
  SELECT * FROM read_json('tcpipe-store/runs/*.json', filename = 'file', columns = {run_id: 'VARCHAR', recipe_id: 'VARCHAR',
    robot: 'VARCHAR', ingest_key: 'VARCHAR', blob: 'VARCHAR', segments: 'BIGINT', distance_by_reason_m: 'MAP(VARCHAR, DOUBLE)',
    recording: 'STRUCT(first_ns BIGINT, last_ns BIGINT, "rows" BIGINT, beginning VARCHAR)'})
  QUALIFY row_number() OVER (PARTITION BY split_part(file, '.', -4) ORDER BY split_part(file, '.', -3)::INT DESC, file) = 1)
SELECT * FROM newest WHERE blob <> ''   -- without superseded runs:
  QUALIFY recording IS NULL OR row_number() OVER (PARTITION BY robot, ingest_key, recording.first_ns, recording.beginning
    ORDER BY recording.last_ns DESC, recording.rows DESC) = 1;

SET VARIABLE files = (SELECT list('tcpipe-store/blobs/' || blob || '/segments.parquet') FROM runs WHERE recipe_id = '1a2b3c4d');
SELECT robot, count(*), avg(power_watt) FROM read_parquet(getvariable('files'), union_by_name = true) GROUP BY robot;
