"""The same stream of targets through several ways of driving a Franka arm, on one simulator."""
