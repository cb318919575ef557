#!/bin/sh
# running, success or failed, for a job of PBS. A job that was killed leaves no other trace.
described=$(qstat -x -f "$1" 2>/dev/null) || described=
case $described in
  *"job_state = F"*"Exit_status = 0"* | *"Exit_status = 0"*"job_state = F"*) echo success ;;
  *"job_state = F"*) echo failed ;;
  # A queue that does not answer for a moment says nothing about the job.
  *) echo running ;;
esac
