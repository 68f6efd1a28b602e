"""Values of the touches that the tests of `view` show."""

SCRIPT = "<script>document.title = 'broken'</script><img src=x onerror=alert(1)>"
DEPTHS = (0, 60, 90)  # of the frames of each recording
