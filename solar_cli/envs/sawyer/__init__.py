"""A Sawyer arm that stacks Lego bricks, in PyBullet or in MuJoCo."""
