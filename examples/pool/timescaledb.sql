-- Makes hypertables of the tables of a pool that grow with time. The owner of the tables runs it
-- once, after the first 'webots-mcp ship', while nobody ships:
--
--   psql --single-transaction -v ON_ERROR_STOP=1 -d robots -f timescaledb.sql
--
-- It needs TimescaleDB 2.13 or newer (by_range). Rows are copied, so do it while there are few.
-- Columns, keys and indexes stay; rights on these tables and on the views are to be granted again.

CREATE EXTENSION IF NOT EXISTS timescaledb;

-- The views stand on the tables that are replaced: they are made again from their own definitions,
-- in the order in which they were made.
CREATE TEMPORARY TABLE kept_view ON COMMIT DROP AS
  SELECT oid AS made, relname AS name, pg_get_viewdef(oid) AS definition,
    obj_description(oid) AS comment
  FROM pg_class WHERE relkind = 'v' AND relnamespace = current_schema()::regnamespace;

CREATE TEMPORARY TABLE cut_by_time ON COMMIT DROP AS
  SELECT relname AS name FROM pg_class JOIN pg_partitioned_table ON pg_class.oid = partrelid
  WHERE relnamespace = current_schema()::regnamespace;

-- Plain tables in the place of partitioned ones, of which no hypertable can be made.
DO $$
DECLARE
  each record;
BEGIN
  FOR each IN SELECT * FROM kept_view ORDER BY made DESC LOOP
    EXECUTE format('DROP VIEW %I', each.name);
  END LOOP;
  FOR each IN SELECT * FROM cut_by_time LOOP
    EXECUTE format('CREATE TABLE %I (LIKE %I INCLUDING ALL)', each.name || '_plain', each.name);
    EXECUTE format('INSERT INTO %I SELECT * FROM %I', each.name || '_plain', each.name);
    EXECUTE format('DROP TABLE %I', each.name);
    EXECUTE format('ALTER TABLE %I RENAME TO %I', each.name || '_plain', each.name);
  END LOOP;
  FOR each IN SELECT * FROM kept_view ORDER BY made LOOP
    EXECUTE format('CREATE VIEW %I AS %s', each.name, each.definition);
    EXECUTE format('COMMENT ON VIEW %I IS %L', each.name, each.comment);
  END LOOP;
END $$;

-- 'webots-mcp ship' asks for the months that it writes to. Chunks are made by TimescaleDB.
CREATE OR REPLACE FUNCTION make_partition(parent text, year integer, month integer) RETURNS void
LANGUAGE sql AS '';

-- Wall times are seconds since 1970. A clock may have been anywhere: what lies beyond 2100 shares
-- the last chunk, instead of being refused.
CREATE FUNCTION chunk_time(wall_time_s double precision) RETURNS timestamptz
LANGUAGE sql IMMUTABLE PARALLEL SAFE
AS 'SELECT to_timestamp(least(greatest(wall_time_s, 0), 4102444800))';

SELECT create_hypertable(
  quote_ident(name)::regclass,
  by_range('wall_time_s', interval '7 days', partition_func => 'chunk_time'),
  create_default_indexes => false, migrate_data => true
) FROM cut_by_time;
