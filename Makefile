.PHONY: demo tests check docs benchmarks schema
demo tests check docs benchmarks:
	./run $@

schema:  ## generate webots_mcp/database/schema.sql from the migrations
	.venv/bin/python -m migrations.generate > schema.new && mv schema.new webots_mcp/database/schema.sql
