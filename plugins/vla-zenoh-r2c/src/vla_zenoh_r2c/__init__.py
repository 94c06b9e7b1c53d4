"""Huawei's R2C on our bus: its robots ask models of ours, its policies are workers of ours."""
