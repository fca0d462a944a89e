.PHONY: demo tests check benchmarks schema
demo tests check benchmarks:
	./run $@

schema:  ## generate webots_mcp/schema.sql from the migrations
	.venv/bin/python -m webots_mcp.store.migrate > schema.new && mv schema.new webots_mcp/schema.sql
