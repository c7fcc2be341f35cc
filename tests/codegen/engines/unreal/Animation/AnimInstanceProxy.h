/* In AnimNode_SkeletalControlBase.h. */
