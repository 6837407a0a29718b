"""Physical effects that a declared model may lack, as equations; one small file each."""
