# Run by wsl.py: where Webots and webots-mcp are on Windows, as JSON.
[Console]::OutputEncoding = [Text.Encoding]::UTF8
$ProgressPreference = 'SilentlyContinue'
$homes = @($env:WEBOTS_HOME, "$env:ProgramFiles\Webots", "$env:LOCALAPPDATA\Programs\Webots")
$webots = $homes | Where-Object { $_ -and (Test-Path "$_\msys64\mingw64\bin\webots.exe") }
$server = $null
$version = $null
foreach ($name in 'webots-mcp.exe', 'py.exe', 'python.exe') {
  $found = Get-Command $name -CommandType Application -ErrorAction SilentlyContinue
  if (-not $found) { continue }
  $program = @($found)[0].Source
  $module = @()
  if ($name -ne 'webots-mcp.exe') { $module = @('-m', 'webots_mcp') }
  $version = & $program @module --version 2>$null
  if ($LASTEXITCODE -eq 0) { $server = @($program) + $module; break }
}
ConvertTo-Json -Compress @{
  webots = @($webots)[0]; server = $server; version = "$version"
}
