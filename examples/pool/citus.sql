-- Spreads a pool over the nodes of a Citus cluster, each recording whole on one of them. The owner
-- of the tables runs it once on the coordinator, after the first 'webots-mcp ship', while nobody
-- ships:
--
--   psql --single-transaction -v ON_ERROR_STOP=1 -d robots -f citus.sql
--
-- Every key of a pool begins with the recording's UUID, and every view joins by it: so a shipment,
-- and a question about one recording, are work for one node. What names no recording is asked of
-- all nodes at once. `run_owner` (which run is whose) and the version stay on the coordinator: they
-- are small, and belong to no single recording.

CREATE EXTENSION IF NOT EXISTS citus;

SELECT create_distributed_table('recording', 'recording_uuid');

SELECT create_distributed_table(
  quote_ident(relname)::regclass, 'recording_uuid', colocate_with => 'recording'
)
FROM pg_class JOIN pg_attribute ON attrelid = pg_class.oid AND attname = 'recording_uuid'
WHERE relkind IN ('r', 'p') AND NOT relispartition
  AND relnamespace = current_schema()::regnamespace
  AND relname NOT IN ('recording', 'run_owner')
ORDER BY relname;
