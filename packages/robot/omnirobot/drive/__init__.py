"""What stands between a policy and the motors: control, guard, operator and the record of a run."""
